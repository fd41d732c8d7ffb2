"""One file for each command of `voxscene eval`."""
