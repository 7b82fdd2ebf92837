"""Measure rendered pictures and fitted runs against photographs and ground truth."""
