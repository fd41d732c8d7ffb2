"""Cameras, rigid transforms, densities on them in one base measure, and sets of poses.

Imports recordings alone.
"""
