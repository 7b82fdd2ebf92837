"""The physics self-test of the installed program: `climatenerf verify`."""
