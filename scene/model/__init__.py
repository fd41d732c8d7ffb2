"""The generative model of a scene: graph, coordinates of contacts, priors, presence, posterior density.

Call `posterior.SceneModel`. Imports shapes alone.
"""
