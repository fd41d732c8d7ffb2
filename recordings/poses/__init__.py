"""Where the camera was, as the recorder believed: transforms, odometry and poses."""
