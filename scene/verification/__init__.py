"""Verification of what the search found, by depth and outline; and where missing objects may stand unseen.

`initialisation` calls `reassignment.without_lookalikes`, `parsing` calls `occlusion.unseen_share`. Imports
scene.search and what is below it.
"""
