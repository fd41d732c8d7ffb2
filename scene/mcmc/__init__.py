"""Involutive Markov chain Monte Carlo on scene graphs (stage O): exact moves and adaptive proposals.

Call `sampling.sample_posterior`. Imports scene.search and what is below it.
"""
