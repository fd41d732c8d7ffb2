"""Joint refinement of all keyframe poses: Gauss-Newton on the graph of their overlaps, with covariance.

Call `refinement.refine_keyframes` after the last frame. Imports slam.filter, slam.config and what is below
them.
"""
