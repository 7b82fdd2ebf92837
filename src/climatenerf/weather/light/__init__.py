"""The light of the place: that of its photos, other skies, and what it does to surfaces."""
