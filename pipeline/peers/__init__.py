"""Other people's trackers on the same arrays, each with several settings of which the best counts."""

PEERS = ("kiss-icp", "small-gicp", "open3d")
