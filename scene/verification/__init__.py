"""Verification of detections by the density of the image, and where missing objects may stand unseen.

`initialisation` calls `reassignment.without_lookalikes`, `parsing` calls `occlusion.unseen_share`. Imports
scene.search and what is below it.
"""
