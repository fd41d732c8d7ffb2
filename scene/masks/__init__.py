"""Proposals of poses by convolution with masks of a shape ("compiled detectors", supplement K).

Call `proposal.MaskSearch` for the objects of a frame. A grid of cells holds what the camera saw, masks hold
where a turned shape has surface, their convolution scores every turn in every cell, and a softmax of the
scores gives each its probability. Imports scene.observation, scene.objects and what is below them.
"""
