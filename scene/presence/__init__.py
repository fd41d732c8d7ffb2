"""Which objects are there: a posterior by moves over candidate poses, with every scene graph summed out.

Call `inference.presence_in_scene`. Runs after the poses are refined, and before chains sample them; stands
above `mcmc`, `hidden` and `search`.
"""
