"""The supplement's experiments as one page: the benches, run and gathered by `reproduce`."""
