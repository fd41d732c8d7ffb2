"""Depth rendering of posed objects by ray casting in their distance fields.

Call `object_library.library_of_mesh` for the objects and `depth_rendering.render_layers` for images. Imports
shapes.geometry.
"""
