"""Seasons: the colours of plants and lawns, and the sky above them."""
