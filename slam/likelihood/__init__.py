"""Densities of depth images given a map, p(I | x, M), and of overlaps between keyframes.

Call `image_density.log_image_density`; `noise_calibration` learns the sensor's noise from residuals. Imports
slam.keyframes.
"""
