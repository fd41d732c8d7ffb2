"""Scene-graph inference (stages K to O): which known objects stand where, what rests on what, how surely.

Call `scene.parsing.parse_scene`. Stages in the order of the method: objects and observation, model,
likelihood, search, verification and mcmc, then initialisation and summary, then parsing.
"""
