"""The world frame of a capture: up, scale, ground datum, georeference."""
