"""The generative model of a scene: graph, contact chart, priors, presence, posterior density.

Call `posterior.SceneModel`. Imports shapes alone.
"""
