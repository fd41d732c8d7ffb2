"""Alternative maps where views are far apart: proposed after the last frame, compared, and weighed.

Call `mode_jump.choose_map`. Imports slam.pose_graph and what is below it.
"""
