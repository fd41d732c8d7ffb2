"""The subcommands of `voxscene bench`, one file each."""
