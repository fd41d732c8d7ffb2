"""Values that are not finite, which JSON does not hold and no view can draw: told as such, never fatal.

A stage may rightly end with them: the evidence of a frame that the model gives no density to is -inf.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_FARTHEST_M = 1e7
"""The size of the earth: nothing that was recorded lies beyond."""

if TYPE_CHECKING:
    from scene.result import SceneResult
    from slam.result import SlamResult

    Result = TypeVar("Result", SlamResult, SceneResult)


def finite_json(content: Any) -> Any:
    """Plain values with null for every number that is not finite."""
    if isinstance(content, Mapping):
        return {name: finite_json(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite_json(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def remarks_on(content: Any, where: str = "") -> Iterator[str]:
    """A sentence on each number of plain values that is not finite."""
    if isinstance(content, Mapping):
        for name, value in content.items():
            yield from remarks_on(value, f"{where}.{name}" if where else str(name))
    elif isinstance(content, Sequence) and not isinstance(content, str):
        for number, value in enumerate(content):
            yield from remarks_on(value, f"{where}[{number}]")
    elif isinstance(content, float) and not math.isfinite(content):
        yield f"{where} is {content}, told as null"


def drawable_path(result: SlamResult) -> SlamResult:
    """The same with frames lost whose pose is no rigid transform, and everything that is drawn finite."""
    drawn = are_poses(result.draws)
    usable = _is_rigid(result.mean) & drawn.all(axis=0)
    usable &= _is_small(result.covariance).all(axis=(1, 2))
    weights = np.where(
        np.isfinite(result.log_weights) & (result.log_weights < 1), result.log_weights, -np.inf
    )
    if np.isneginf(weights).all():
        weights = np.full_like(weights, -np.log(len(weights)))
    draws = np.where(drawn[..., None], result.draws, np.asarray([1, 0, 0, 0, 0, 0, 0], np.float32))
    path = replace(_with_finite_poses(result), draws=draws)
    return replace(path, lost=result.lost | ~usable, log_weights=weights)


def drawable_scene(result: SceneResult) -> SceneResult:
    """The same without the objects whose pose or spread is not finite."""
    usable = _is_rigid(result.camera_from_object) & _is_small(result.covariance).all(axis=(1, 2))
    presence = np.where(usable, _probabilities(result.presence), 0.0)
    samples, hidden = (
        np.where(are_poses(poses)[..., None], poses, [1.0, 0, 0, 0, 0, 0, 0])
        for poses in (result.sample_poses, result.hidden_poses)
    )
    return replace(
        _with_finite_poses(result),
        presence=presence,
        sample_poses=samples,
        hidden_poses=hidden,
        edge_probabilities=_probabilities(result.edge_probabilities),
    )


def _probabilities(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest that are probabilities, zero for what is no number."""
    return np.clip(np.nan_to_num(values), 0.0, 1.0)


def are_poses(poses: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether (..., 7) are finite, with a quaternion of some length."""
    small = np.asarray(_is_small(poses).all(axis=-1))
    return small & (np.linalg.norm(np.where(small[..., None], poses, 0.0)[..., :4], axis=-1) > 0)


def _with_finite_poses(result: Result) -> Result:
    """Identity for every matrix (..., 4, 4) that is no rigid transform, zero for spreads of no size."""
    arrays = {field.name: getattr(result, field.name) for field in fields(result)}
    changed = {
        name: np.where(_is_rigid(array)[..., None, None], array, np.eye(4))
        for name, array in arrays.items()
        if array.shape[-2:] == (4, 4) and array.ndim > 2
    }
    spread = _is_small(result.covariance).all(axis=(1, 2), keepdims=True)
    return replace(result, covariance=np.where(spread, result.covariance, 0.0), **changed)


def _is_rigid(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether matrices (..., 4, 4) are finite with a proper rotation."""
    small = np.asarray(_is_small(poses).all(axis=(-2, -1)))
    rotations = np.where(small[..., None, None], poses[..., :3, :3], 0.0)
    product = rotations @ rotations.swapaxes(-2, -1)
    orthogonal = np.isclose(product, np.eye(3), atol=1e-3).all(axis=(-2, -1))
    return small & orthogonal & (np.linalg.det(rotations) > 0)


def _is_small(values: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether numbers are finite, and those of places that a camera can be at."""
    return np.abs(np.nan_to_num(values, nan=np.inf)) < _FARTHEST_M
