"""Evidence for geometry, computed once before a fit."""
