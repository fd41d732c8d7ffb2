"""Shapes: geometry and rendering that slam and scene share, the sensor density, and shape learning.

Call `shapes.learning.distillation.learn_shape`; the result is a `shapes.prior.ShapePrior`.
"""
