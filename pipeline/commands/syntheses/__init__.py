"""The subcommands of `voxscene synth`."""
