"""What one depth frame shows: pooled depth with normals, support plane, foreground, pixel windows.

Call `segmentation.scene_data` for one frame, `segmentation.scene_views` for several of the same scene. The
only home of Open3D in scene (`detection`). Imports scene.execution and shapes.
"""
