"""Experiments that compare many fits."""
