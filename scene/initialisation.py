"""Objects are sought once more where lookalikes were: what took another's place hid it from the search."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import jax
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.config import ParseConfig
from scene.execution import compile_in_background
from scene.likelihood.object_renderer import ObjectRenderer
from scene.objects.scene_object import SceneObject
from scene.observation.frame_data import SceneData
from scene.search.assignment import choose
from scene.search.competing_scenes import PAIRED, RIVALS, best_of, decided, polished_rivals
from scene.search.hypotheses import PosePools
from scene.search.residual import unexplained_by_others
from scene.search.scene_edits import best_scene, rivals
from scene.search.search_result import Initialisation
from scene.search.search_round import COLD, HOT, PARTICLES, SWEEPS, _gains, _orientations, _sought
from scene.verification.reassignment import CONVINCING, convincing, without_lookalikes


def initialise(
    key: jax.Array,
    data: SceneData,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    noise: DepthNoise,
    config: ParseConfig,
) -> Initialisation:
    """Search for the scene in one frame.

    Args:
        key: random key.
        data: the frame.
        objects: what to look for.
        renderer: of the same objects.
        noise: of the sensor.
        config: settings.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    poses = config.pool * (config.rounds + 1) + 1 + RIVALS
    pools = PosePools.of(data, objects, renderer, noise, config, poses, rng)
    seek = partial(_sought, rng, [_orientations(one, data.table) for one in objects])
    *keys, last_key, again_key = jax.random.split(key, config.rounds + 3)
    scene = np.full(len(objects), pools.absent)
    masks = dict.fromkeys(range(len(objects)), data.foreground)
    with compile_in_background(*_kernels(pools)):
        for turn, round_key in enumerate(keys):
            pools, scene = seek(round_key, pools, scene, masks, turn)
            masks = unexplained_by_others(pools, scene)
    settled = Settled.of(*told(last_key, pools, scene, noise), noise)
    settled = without_gaps(again_key, seek, settled, noise)
    pools, scene = settled.pools, settled.scene
    return Initialisation(
        poses=pools.placed(scene).astype(np.float64),
        found=scene < pools.absent,
        log_odds=settled.log_odds,
        pools=pools.poses.astype(np.float64),
        log_gains=np.asarray(_gains(pools.layers, scene), np.float64),
    )


def _kernels(pools: PosePools) -> list[Callable[[], object]]:
    """What the search runs, to be compiled."""
    layers, scene = pools.layers, np.zeros(len(pools.objects), np.int32)
    return [
        lambda: pools.renderer.compile(pools.data.window),
        lambda: best_scene.lower(layers, scene, PAIRED).compile(),
        lambda: choose.lower(jax.random.key(0), layers, HOT, COLD, PARTICLES, SWEEPS).compile(),
        lambda: rivals.lower(layers, scene).compile(),
    ]


class Seek(Protocol):
    """A round of the search."""

    def __call__(
        self,
        key: jax.Array,
        pools: PosePools,
        scene: NDArray[np.integer],
        masks: Mapping[int, NDArray[np.bool_]],
        turn: int,
    ) -> tuple[PosePools, NDArray[np.integer]]:
        """Pools with poses on the masks of those sought, and the best scene (N,) found from one.

        Args:
            key: random key.
            pools: of poses.
            scene: (N,) the best one so far.
            masks: pixels of every object that is sought.
            turn: the round whose poses make room.
        """
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Settled:
    """A scene without lookalikes.

    Attributes:
        pools: of poses.
        scene: (N,).
        log_odds: (N,) of each object being there.
        gaps: whether something was taken out of it.
    """

    pools: PosePools
    scene: NDArray[np.integer]
    log_odds: NDArray[np.float64]
    gaps: bool

    @classmethod
    def of(cls, pools: PosePools, scene: NDArray[np.integer], noise: DepthNoise) -> Settled:
        """What is left of a scene (N,)."""
        left, log_odds = without_lookalikes(pools, scene, noise)
        gaps = (scene < pools.absent) & (left == pools.absent)
        return cls(pools=pools, scene=left, log_odds=log_odds, gaps=bool(gaps.any()))

    @property
    def found(self) -> NDArray[np.bool_]:
        """(N,) objects that are in the scene."""
        return self.scene < self.pools.absent


def told(
    key: jax.Array, pools: PosePools, scene: NDArray[np.integer], noise: DepthNoise
) -> tuple[PosePools, NDArray[np.integer]]:
    """Pools with fits that tell a scene (N,) from those that are about as good, and the best of them."""
    last = pools.absent - 1 - RIVALS
    pools = pools.with_poses(polished_rivals(pools, scene), last)
    scene = np.where((last <= scene) & (scene < pools.absent), last, scene)
    return decided(key, pools, best_of(pools, scene), last, noise)


def without_gaps(key: jax.Array, seek: Seek, best: Settled, noise: DepthNoise) -> Settled:
    """The scene after the missing objects were sought where lookalikes had been, while that finds more.

    As where an object is sought elsewhere, one that is found only then has to look convincing.

    Args:
        key: random key.
        seek: a round of the search.
        best: the scene so far.
        noise: of the sensor.
    """
    last_round = best.pools.config.rounds
    while best.gaps:
        key, seek_key, last_key = jax.random.split(key, 3)
        unexplained = unexplained_by_others(best.pools, best.scene)
        masks = {one: mask for one, mask in unexplained.items() if not best.found[one]}
        sought = seek(seek_key, best.pools, best.scene, masks, last_round)
        pools, scene = told(last_key, *sought, noise)
        if not (convincing(pools, scene, noise) & ~best.found).any():
            break
        other = Settled.of(pools, scene, noise)
        unsure = other.found & ~best.found & (other.log_odds < CONVINCING)
        if other.found.sum() <= best.found.sum() or unsure.any():
            break
        best = other
    return best
