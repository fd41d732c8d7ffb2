"""Things on a table from one colour image (stage B): how many, of which kind, where.

Call `search.Searcher` for a world seen by one camera, then `find` for each image. No depth, no training.
Imports scene.objects and shapes.
"""
