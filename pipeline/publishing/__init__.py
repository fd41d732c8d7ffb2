"""Files derived from a run's committed values: summaries, trajectories, poses, run.mcap, run.rrd."""
