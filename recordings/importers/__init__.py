"""Turning the folders and bags of other programs into recordings, one format a file."""
