"""Objects that no pixel shows: whether they are there, and where (supplement L, Fig. 7).

Call `hidden_objects.hidden_posterior`: the exact posterior of one hidden object or two, by importance
sampling over their prior poses. `parsing` calls `hidden_places.hidden_places` for all objects.
Imports observation, likelihood and what is below them.
"""
