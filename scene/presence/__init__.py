"""Which objects are there: a posterior by moves over candidate poses, with every scene graph summed out.

Runs after the chains, which tell where to look; stands above `mcmc`, `hidden` and `search`.
"""
