"""Things on a table from one colour image (stage B): how many, of which kind, where.

Call `lattice.Lattice.of` for a world seen by one camera, then `search.find` for each image. No depth, no
training. Imports scene.objects and shapes.
"""
