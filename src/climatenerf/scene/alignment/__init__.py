"""Alignment of a capture to the world frame: up, scale, ground datum and georeference."""
