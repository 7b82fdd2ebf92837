"""Experiments that compare many fits, or many methods."""
