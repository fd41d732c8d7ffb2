"""Alternative maps where views are far apart: proposed after the last frame, compared, and weighed.

Call `mode_jump.choose_map`. Imports slam.pose_graph, slam.config and what is below it.
"""
