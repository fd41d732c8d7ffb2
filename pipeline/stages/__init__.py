"""One file for each stage: what it depends on, and the function that computes its value."""
