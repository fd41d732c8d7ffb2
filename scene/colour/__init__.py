"""Things on a table from one colour image (stage B): how many, of which kind, where.

Call `search.Searcher` for a world seen by one camera, then `find` for each image. Imports shapes and recordings
alone: no depth, no training.
"""
