"""Densities: of a depth image given a map, p(I | x, M), and of one keyframe's points given another's surface.

Call `image_density.log_image_density`; `noise_calibration` learns the sensor's noise from residuals. Imports
slam.keyframes.
"""
