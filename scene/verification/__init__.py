"""Verification of detections by the density of the image.

`initialisation` calls `reassignment.without_lookalikes`. Imports scene.search and what is below it.
"""
