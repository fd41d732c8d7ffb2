"""Errors that all pixels of an object have in common: of the camera's scale, of shapes, of calibration.

Chains tell where objects appear to be, since the density takes the errors of shapes for independent between
pixels. Where they are, given where they appear, is Normal: farther or nearer by the camera's scale, all of
them alike, and off by the error of shapes and calibration, each as a whole. Samples get a draw of these
(consider parameters, docs/model.md section O), so that everything that is made of samples holds them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shapes.geometry.poses import motions_of


def with_common_errors(
    rng: np.random.Generator,
    boxes: NDArray[np.float64],
    radii_m: NDArray[np.float64],
    scale_error: float,
    error_m: float,
) -> NDArray[np.float64]:
    """Samples (S, N, 4, 4) of where boxes are from where they appear, in the camera.

    Args:
        rng: random numbers.
        boxes: (S, N, 4, 4) camera_from_box, about the objects' centres.
        radii_m: (N,) of the objects; their surface errs by `error_m` at this distance when they turn.
        scale_error: standard deviation of the camera's scale about 1, of a sample.
        error_m: standard deviation along each axis, of an object in a sample.
    """
    count, objects = boxes.shape[:2]
    scaled = np.array(boxes)
    scaled[..., :3, 3] *= 1 + scale_error * rng.standard_normal((count, 1, 1))
    per_metre = np.concatenate([np.ones((objects, 3)), np.tile(1 / radii_m[:, None], 3)], axis=1)
    return scaled @ motions_of(error_m * per_metre * rng.standard_normal((count, objects, 6)))
