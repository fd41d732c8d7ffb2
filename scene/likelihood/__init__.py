"""Densities of observed depth given a scene, and the renderer that they share.

Call `depth_images.DepthLikelihood`, or `point_clouds.CloudLikelihood` for point clouds. Imports
scene.observation, scene.model, scene.objects, scene.config and scene.execution.
"""
