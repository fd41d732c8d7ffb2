"""The search for a maximum (stage K): pose hypotheses, their joint assignment, local refinement.

Call `search_round.SearchRound` for one round and `importance_sampling.refine` for Gaussians round the poses
found. Gives starts and proposals, never samples. Imports scene.likelihood and what is below it.
"""
