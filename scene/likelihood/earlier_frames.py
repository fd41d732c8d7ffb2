"""What the frames of a scene have measured before each of them: depths foretold from one frame to another.

Frames have an order, and each has the density of its image given those before it. All show the same surfaces,
and share what a mesh or a support errs by; taken for independent they would count these errors once each.
Depths that earlier frames measured, seen from where the camera is now, foretell its image but for the
sensor's noise and the error of the motion between (docs/model.md, section L2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from scene.likelihood.unknown_surfaces import (
    EITHER,
    ITERATIONS,
    JOINED_M,
    LEAST_SCALE,
    LEAST_WEIGHT,
    EarlierWeights,
    UnknownSurfaces,
    UnknownWeights,
    told_otherwise,
)
from scene.observation.depth_view import pixels_at, unproject
from scene.observation.frame_data import SceneData
from shapes.depth_noise import standard_deviation
from shapes.geometry.poses import transform_points
from shapes.stored_kernels import jit_stored

STEPS = 64
"""Points of a ray that are looked at: 2 cm apart, as surfaces are, where things are a metre away."""


def earlier_depths(
    views: Sequence[SceneData], camera_from_world: NDArray[np.float64], order: Sequence[int]
) -> list[NDArray[np.float32]]:
    """Depth (H, W) at the compared pixels of each view that frames before it in `order` have measured.

    `NO_RETURN` where none has; of several the last.

    Args:
        views: F frames.
        camera_from_world: (F, 4, 4).
        order: of the F frames.
    """
    told_m = [np.full_like(view.window.depth_m, NO_RETURN) for view in views]
    for place, frame in enumerate(order):
        for earlier in order[:place]:
            camera_from_earlier = camera_from_world[frame] @ np.linalg.inv(camera_from_world[earlier])
            seen_m = _seen_from(views[frame], views[earlier], camera_from_earlier)
            told_m[frame] = np.where(seen_m == NO_RETURN, told_m[frame], seen_m)
    return told_m


def _seen_from(
    view: SceneData, other: SceneData, camera_from_other: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Depth (H, W) at the compared pixels of a view of what another has measured, `NO_RETURN` where nothing.

    Of the points nearer to a pixel than to others those of the nearest surface count, by their mean: it has
    less noise than one of them. What is out of sight for all that the other has seen is left out.
    """
    window, measured = view.window, other.depth_m != NO_RETURN
    points_m = transform_points(camera_from_other, unproject(other.depth_m, other.intrinsics)[measured])
    height, width = window.depth_m.shape
    rows, columns, use = pixels_at(points_m, window.camera, (height, width))
    pixels, depth_m = (rows * width + columns)[use], points_m[use, 2]
    first_m = np.full(height * width, np.inf)
    np.minimum.at(first_m, pixels, depth_m)
    joined = depth_m < first_m[pixels] + JOINED_M
    count = np.bincount(pixels[joined], minlength=height * width)
    total_m = np.bincount(pixels[joined], depth_m[joined], minlength=height * width)
    seen_m = np.where(count > 0, total_m / np.maximum(count, 1), NO_RETURN)
    seen_m = seen_m.reshape(height, width).astype(np.float32)
    return np.where(_is_hidden(view, seen_m, other, camera_from_other), np.float32(NO_RETURN), seen_m)


def _is_hidden(
    view: SceneData,
    seen_m: NDArray[np.float32],
    other: SceneData,
    camera_from_other: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Where (H, W) a ray to what another view has seen (H, W) passes behind a surface that it has seen.

    What is there it does not know: from the other side the table behind a thing is in its sight.
    """
    rays = unproject(np.ones_like(seen_m), view.window.camera)
    lengths_m = np.maximum(seen_m - JOINED_M, 0.0)[..., None] * np.linspace(0.0, 1.0, STEPS)
    points_m = transform_points(
        np.asarray(np.linalg.inv(camera_from_other), np.float64), rays[:, :, None] * lengths_m[..., None]
    )
    rows, columns, inside = pixels_at(points_m, other.intrinsics, other.depth_m.shape)
    measured_m = other.depth_m[rows, columns]
    behind = points_m[..., 2] > measured_m + JOINED_M
    return (inside & (measured_m != NO_RETURN) & behind).any(axis=-1)


def with_earlier(
    learned: UnknownWeights,
    images_m: Sequence[NDArray[np.float32]],
    earlier_m: Sequence[NDArray[np.float32]],
    noise: DepthNoise,
) -> UnknownWeights:
    """Weights with how well earlier frames foretell images, by expectation maximisation.

    Args:
        learned: how well pixels foretell each other.
        images_m: (H, W) each.
        earlier_m: (H, W) what an earlier frame measured there, `NO_RETURN` where none did.
        noise: of the sensor.
    """
    parts = [_foretold(*images, noise, learned) for images in zip(images_m, earlier_m, strict=True)]
    differs, errors, sensor_m, density = (np.concatenate(leaves) for leaves in zip(*parts, strict=True))
    fits = [_mixed_in(errors[mine], sensor_m[mine], density[mine]) for mine in (~differs, differs)]
    weights, scales = np.array(fits, np.float32).T
    return replace(learned, earlier=EarlierWeights(weights, scales))


def _foretold(
    depth_m: NDArray[np.float32],
    earlier_m: NDArray[np.float32],
    noise: DepthNoise,
    learned: UnknownWeights,
) -> tuple[NDArray, ...]:
    """How an earlier frame foretells those pixels (n,) of an image that it has measured.

    Returns:
        Whether the pixels before foretell another depth; the errors in standard deviations of the sensor;
        these in metres; the density of the depth by the pixels before alone.
    """
    both = (depth_m != NO_RETURN) & (depth_m <= float(learned.reach_m)) & (earlier_m != NO_RETURN)
    of_pixels = _foretold_by_pixels(depth_m, earlier_m, noise, learned)
    density, differs, sensor_m = (np.asarray(part)[both] for part in of_pixels)
    return differs, (depth_m - earlier_m)[both] / sensor_m, sensor_m, density


@jit_stored()
def _foretold_by_pixels(
    depth_m: jax.Array, earlier_m: jax.Array, noise: DepthNoise, learned: UnknownWeights
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Density (H, W) of an image given the pixels before, and whether these foretell another depth.

    And the sensor's standard deviation at the depths of an earlier frame.
    """
    alone = UnknownSurfaces.of(depth_m, noise, learned)
    parts = [*alone.density_parts(depth_m), alone.weights[-1] * alone.new_density(depth_m)]
    known = alone.weights[EITHER] > 0
    seen_m, differs = told_otherwise(earlier_m, alone.means_m[EITHER], known, noise)
    return jnp.asarray(sum(parts)), differs > 0, standard_deviation(noise, seen_m)


def _mixed_in(
    errors: NDArray[np.float32], sensor_m: NDArray[np.float32], other: NDArray[np.float32]
) -> tuple[float, float]:
    """Weight and scale of one more prediction beside a density (n,) of as many depths."""
    weight, scale = 0.5, 1.0
    if not len(errors):
        return 0.0, scale
    for _ in range(ITERATIONS):
        told = weight * np.exp(-0.5 * (errors / scale) ** 2) / (np.sqrt(2 * np.pi) * scale * sensor_m)
        share = told / (told + (1 - weight) * other)
        weight = float(np.clip(share.mean(), LEAST_WEIGHT, 1 - LEAST_WEIGHT))
        scale = float(np.sqrt((share * errors**2).sum() / share.sum().clip(1e-9)).clip(LEAST_SCALE))
    return weight, scale
