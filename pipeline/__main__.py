"""`python -m pipeline` is `voxscene`."""

from pipeline.cli import main

main()
