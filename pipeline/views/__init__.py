"""A run as Rerun shows it: the only home of rerun. MCAP is the record; these views can be made again."""
