"""The map: keyframe depth images as surface elements, fused, rendered, chosen for comparison with a view.

Call `surfels.surfel_image` for one frame and `keyframe_map.KeyframeMap` for all of them. Imports shapes and
recordings alone.
"""
