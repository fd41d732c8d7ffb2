"""Learning a shape from depth images: occupancy for one trajectory, and the mixture over trajectories."""
