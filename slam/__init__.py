"""Camera tracking (stage J): where the camera was in every frame, and how surely.

Call `slam.tracking.track`. Stages in the order of the method, each may import those before it: keyframes,
likelihood, registration, filter, pose_graph, then map_hypotheses and smoothing, then tracking.
"""
