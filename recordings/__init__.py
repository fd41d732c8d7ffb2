"""What a camera saw: reading and writing recordings, with NumPy, Pillow and readers of files alone."""
