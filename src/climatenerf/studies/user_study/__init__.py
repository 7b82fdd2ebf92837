"""A user study: pairs of pictures for participants, and the statistics of their votes."""
