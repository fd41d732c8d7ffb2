"""Measurements of what the program's own functions do: speed and accuracy beside peers, in one run."""
