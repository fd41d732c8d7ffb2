"""Known objects: surface, bounding box, resting orientations, symmetries, and slots of those found.

Call `scene_object.scene_object` with a mesh. Imports shapes alone.
"""
