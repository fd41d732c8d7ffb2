"""The filter over camera trajectory and map: sequential Monte Carlo over hypotheses, Gaussians within.

Call `init.init` with the first frame and `step.step` with every further one. Imports slam.registration,
slam.config and what is below them.
"""
