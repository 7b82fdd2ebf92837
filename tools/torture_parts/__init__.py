"""Parts of `tools/torture.py`: valid inputs, mutations, the process that runs verbs, faults."""
