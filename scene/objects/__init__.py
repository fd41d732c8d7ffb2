"""Known objects: surface, bounding box, resting orientations, symmetries; slots of chains for those found.

Call `scene_object.scene_object` with a mesh. Imports shapes alone.
"""
