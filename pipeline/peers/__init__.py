"""Other people's methods on the same arrays, each with several settings of which the best counts."""

PEERS = ("kiss-icp", "small-gicp", "open3d")
"""Trackers."""
REGISTRATIONS = ("fpfh", "icp24", "ppf")
"""Estimators of an object's pose, with settings in `pipeline.peers.registration`."""
VOXEL_MAPS = ("carving", "votes", "octomap", "tsdf")
"""Learners of shapes, with settings in `pipeline.benchmarks.shapes`."""
