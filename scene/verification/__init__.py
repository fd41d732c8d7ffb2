"""Verification of detections by appearance, and where missing objects may stand unseen.

Call `reassignment.without_lookalikes` and `occlusion.unseen_share`. Imports scene.search and what is below
it.
"""
