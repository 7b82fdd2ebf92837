"""`climatenerf stylize`: a run in the colours of a season, of photos, or of a text."""
