"""Flood water: a horizontal surface with waves, a body of water and a bottom."""
