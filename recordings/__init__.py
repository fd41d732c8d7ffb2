"""What a camera saw: reading and writing recordings, with nothing heavier than NumPy, Pillow and readers of files."""
