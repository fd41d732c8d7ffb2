"""The search for a maximum (supplement K): pose hypotheses, their joint assignment, local refinement.

Call `search_round.SearchRound` for one round. Gives the chains' starts and proposals, never samples. Imports
scene.likelihood, scene.config and what is below them.
"""
