"""A depth sensor's noise from its own images, without truth: `noise_estimate.estimate_noise`.

Residuals of small windows about smooth surfaces tell sigma over depth and how far errors are alike.
Imports geometry's neighbours alone: numpy, SciPy and `recordings`.
"""
