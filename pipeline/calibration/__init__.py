"""What recordings tell of their sensor: `images` of one camera, `field` of a moving one, `calibrate` all."""
