"""Fallen snow: metaballs on upward surfaces."""
