"""Flood water: a level surface with waves, a body and a bed."""
