"""Registration of one frame against the map: local Gauss-Newton alignment and global search.

Call `search.Searcher`: `at` a pose, `near` predictions, `anywhere` in the map. Imports slam.likelihood and
what is below it.
"""
