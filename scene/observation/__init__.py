"""What one depth frame shows: pooled depth with normals, support plane, foreground, pixel windows.

Call `segmentation.scene_data`, or `segmentation.frame_data` for further frames of the same scene. The only
home of Open3D in scene (`detection`). Imports scene.execution and shapes.
"""
