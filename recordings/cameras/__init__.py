"""Which camera took a topic's images, and the pinhole camera that its depth is given in."""
