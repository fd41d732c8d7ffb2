"""The map: keyframe depth images as surface elements, fused, rendered and selected.

Call `surfels.surfel_image` for one frame and `keyframe_map.KeyframeMap` for all of them. Imports shapes and
recordings alone.
"""
