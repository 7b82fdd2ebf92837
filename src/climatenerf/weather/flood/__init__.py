"""Flood water: waves about one level, a body of water, and a shore."""
