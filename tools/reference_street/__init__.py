"""A small street modelled in code, and its path-traced pictures and ground truth."""
