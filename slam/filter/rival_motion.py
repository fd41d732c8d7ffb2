"""How far the camera may be from where it was found because something else than the room moves with it.

Nothing but shares of the image tells which of two motions is the room's: each is with the probability that a
pixel, out of those that only one of them explains, is explained by it. A keyframe that was placed in doubt
hands its doubt on: the same thing is followed by mistake, or none is, so that displacements add up instead of
averaging out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.distortion_field import PRIOR_SD_PER_M
from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY
from shapes.geometry.poses import relative_pose
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.surfels import SurfelImage
from slam.likelihood.noise_calibration import NoiseCalibration
from slam.registration.second_motion import TwoMotions, explained_share, two_motions

LEAST_EXPLAINED = 0.5
"""Of the returns, what an earlier view must explain by either motion to say anything of a frame: most."""

LEAST_CONTRADICTING = 0.25
"""The same to end a doubt: half of that, for the camera goes on, and what began a doubt at the edge of what
an earlier view explains could never end it."""

LEAST_RIVAL = 0.05
"""Of the returns, what a second motion must explain alone: less leaves the first one with 95%."""

BENT = 0.25
"""Standard deviation of a displacement in all directions, relative to its size: what moves is not quite
rigid, and a map of two motions is bent. Chosen by hand."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Doubt:
    """What a second motion leaves open about one frame.

    Attributes:
        displacements: (6, 8) from where it was found, in the camera's chart, each times the root of its
            probability: to either motion, and along six axes as far as the second is uncertain; D D^T is the
            second moment that they add.
        rival_share: of the returns, what the second motion alone explains; 0 where there is none.
    """

    displacements: NDArray[np.float32]
    rival_share: float

    @property
    def shift_m(self) -> float:
        """Standard deviation of the position, all axes together, that it adds."""
        return float(np.linalg.norm(self.displacements[:3]))


CERTAIN = Doubt(np.zeros((6, 8), np.float32), 0.0)
"""Nothing moves against the camera."""


@dataclass(frozen=True)
class RivalMotion:
    """What has moved against the camera's found motion since an earlier view.

    Attributes:
        reference: that view, which no later frame has refined: of the last keyframe that was not in doubt, as
            long as it explains most of a frame.
        pose: (7,) where it was found.
        of_reference: (6, 8) displacements of `Doubt` of that view.
        second: (7,) reference_from_camera of the last frame by the other motion; the identity, as of what is
            fixed to the camera, where there was none.
        of_keyframes: (6, 8) for each keyframe the displacements of `Doubt`.
    """

    reference: SurfelImage
    pose: jax.Array
    of_reference: NDArray[np.float32]
    second: jax.Array
    of_keyframes: tuple[NDArray[np.float32], ...]

    @classmethod
    def since(cls, surface: SurfelImage) -> RivalMotion:
        """The first keyframe is in its place by definition."""
        here = jnp.asarray(IDENTITY, jnp.float32)
        doubt = CERTAIN.displacements
        return cls(surface, here, doubt, here, (doubt,))

    def with_keyframe(self, surface: SurfelImage, pose: jax.Array, doubt: Doubt) -> RivalMotion:
        """A new keyframe, found at (7,); the next frames are compared with it unless it is in doubt."""
        of_keyframes = (*self.of_keyframes, doubt.displacements)
        if doubt.rival_share > 0:
            return replace(self, of_keyframes=of_keyframes)
        here = jnp.asarray(IDENTITY, jnp.float32)
        return RivalMotion(surface, pose, doubt.displacements, here, of_keyframes)

    def with_doubt(self, keyframe: int, displacements: NDArray[np.float32]) -> RivalMotion:
        """With other displacements (6, 8) of a keyframe."""
        before, after = self.of_keyframes[:keyframe], self.of_keyframes[keyframe + 1 :]
        return replace(self, of_keyframes=(*before, displacements, *after))


def doubt_of_frame(
    rival: RivalMotion,
    view: CanvasView,
    calibration: NoiseCalibration,
    found: jax.Array,
    anchor: int,
    anchor_pose: jax.Array,
) -> tuple[RivalMotion, Doubt]:
    """Whether a second motion says otherwise of a frame, and what is compared from then on.

    Where one motion does, the frame shares the doubt of the earlier view, if that explains enough of it, and
    so does the keyframe next to it: a single image said otherwise. Else it shares that keyframe's.

    Args:
        rival: after the frame before.
        view: the frame.
        calibration: the sensor.
        found: (7,) where it was found.
        anchor: the keyframe next to it.
        anchor_pose: (7,) of that keyframe.
    """
    first = relative_pose(rival.pose, found)
    two = two_motions(rival.reference, view, calibration.noise, first, rival.second)
    if two is not None:
        displacements, share, second = _judged(two, first, jnp.asarray(rival.of_reference))
        if float(share) > 0:
            return replace(rival, second=second), Doubt(np.asarray(displacements), float(share))
    rival = replace(rival, second=jnp.asarray(IDENTITY, jnp.float32))
    of_anchor, bent = rival.of_keyframes[anchor], _with_distortion(calibration.noise)
    is_one = two is None or float(two.log_odds) <= 0
    if (
        is_one
        and of_anchor.any()
        and explained_share(rival.reference, view, bent, first) > LEAST_CONTRADICTING
    ):
        seen_here = _carried(rival.of_reference, rival.pose, found)
        return rival.with_doubt(anchor, _carried(seen_here, found, anchor_pose)), Doubt(seen_here, 0.0)
    return rival, Doubt(_carried(of_anchor, anchor_pose, found), 0.0)


def _with_distortion(noise: DepthNoise) -> DepthNoise:
    """The noise with what a sensor's unknown distortion makes of depths that two of its pixels measure."""
    bent = math.sqrt(2) * PRIOR_SD_PER_M
    return replace(noise, sigma_growth_per_m=math.hypot(noise.sigma_growth_per_m, bent))


def _carried(displacements: NDArray[np.float32], origin: jax.Array, pose: jax.Array) -> NDArray[np.float32]:
    """Displacements (6, 8) of what is at one pose (7,), as those of what moves with it at another."""
    return np.asarray(pose_gaussian.carried_along(relative_pose(origin, pose)) @ displacements)


@jax.jit
def _judged(
    two: TwoMotions, first: jax.Array, of_reference: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Displacements (6, 8), share of the second motion, 0 where there is none, and that motion (7,)."""
    away = jax.vmap(lambda pose: pose_gaussian.coordinates(first, pose))(two.poses)
    other = jnp.argmax((away**2).sum(axis=1))
    probabilities = two.shares / jnp.maximum(two.shares.sum(), 1e-6)
    size = jnp.repeat(jnp.linalg.norm(away[other].reshape(2, 3), axis=1), 3)
    spread = jnp.linalg.cholesky(two.covariances[other] + jnp.diag((BENT * size) ** 2 + 1e-12))
    moved = jnp.concatenate(
        [jnp.sqrt(probabilities)[None] * away.T, jnp.sqrt(probabilities[other]) * spread], axis=1
    )
    is_two = (two.log_odds > 0) & (two.explained > LEAST_EXPLAINED) & (two.shares[other] > LEAST_RIVAL)
    is_two &= jnp.isfinite(moved).all()
    displacements = pose_gaussian.carried_along(first) @ of_reference + moved
    return displacements, jnp.where(is_two, two.shares[other], 0.0), two.poses[other]
