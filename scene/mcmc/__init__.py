"""Involutive Markov chain Monte Carlo on scene graphs (supplement O): exact moves and adaptive proposals.

Call `sampling.sample_posterior`. Imports scene.search, scene.config and what is below them.
"""
