"""What a camera saw: reading and writing recordings, with nothing heavier than NumPy, mcap and Pillow."""
