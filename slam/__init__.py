"""Camera tracking (supplement J): where the camera was in every frame, and how surely.

Call `slam.tracking.track`. Each frame passes registration and the filter; after the last one alternative maps
are compared (map_hypotheses), all keyframes refined jointly (pose_graph), trajectories smoothed (smoothing).

Imports run downward: tracking; map_hypotheses, smoothing; pose_graph; filter; registration; likelihood;
keyframes, config, result and odometry (a motion estimate by KISS-ICP). What all frames left behind is kept
in history, and written and read again by checkpoint, which a tracker that was killed goes on from.
"""
