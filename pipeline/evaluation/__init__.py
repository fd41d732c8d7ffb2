"""Measures of a result against the truth."""
