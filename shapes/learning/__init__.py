"""Shape learning (supplement I): occupancy of voxels by expectation propagation, distilled over particles.

Call `distillation.learn_shape`. Imports the rest of shapes.
"""
