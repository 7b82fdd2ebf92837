"""Readers of captures, one for each format."""
