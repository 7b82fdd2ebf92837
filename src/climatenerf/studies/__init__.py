"""Experiments on many fits."""
