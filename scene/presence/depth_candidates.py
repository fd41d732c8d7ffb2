"""Candidate poses of slots in depth images: what they show in every frame, and their prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.likelihood.compared_frames import ComparedFrames
from scene.likelihood.object_density import layer_gains
from scene.likelihood.object_renderer import ObjectRenderer
from scene.presence.pose_priors import PosePriors
from scene.presence.solids import log_sizes_density, solid_half_sizes, solid_layers
from scene.presence.toggling import Candidates, SlotLayers
from shapes.geometry.poses import matrices_of, poses_of

Shown = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Depth at which pixels (..., X) are hidden, and their log density over that of the scene without objects."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PresenceFrames:
    """The frames as presence sees them: all of their windows' pixels count.

    Attributes:
        compared: the frames.
        renderer: of the N objects' shapes, or of S draws of each, draw after draw.
        log_half: (N, 3) logs of half sizes of the objects' boxes.
    """

    compared: ComparedFrames
    renderer: ObjectRenderer
    log_half: NDArray[np.float64]

    @property
    def pixels(self) -> int:
        """X."""
        return sum(view.window.depth_m.size for view in self.compared.views)

    def drawn_shapes(self, rng: np.random.Generator, shape: int | tuple[int, ...]) -> NDArray[np.intp]:
        """Numbers of draws of an object's shape, that many."""
        return rng.integers(self.renderer.draws, size=shape)

    def shown(
        self, slots: NDArray[np.integer], states: NDArray[np.float64], shapes: NDArray[np.integer] | int = 0
    ) -> Shown:
        """Depth and log gain (n, X) of slots (n,) in states (n, 10), of these draws (n,) of their shapes.

        A state is world_from_box and logs of half sizes.
        """
        numbers = shapes * len(self.log_half) + slots
        scales = np.exp(states[:, 7:] - self.log_half[slots])

        def in_frame(frame: int, in_camera: NDArray[np.float64]) -> Shown:
            layers_m = self.renderer.layers(numbers, in_camera, self.compared.views[frame].window, scales)
            depth_m, gain = layer_gains(self.compared.densities[frame], layers_m)
            colours = self.compared.colours
            if colours is not None and self.compared.searched == frame:
                factors = self.compared.colour_weight * colours.log_factors(slots, in_camera, layers_m)
                shown = np.isfinite(depth_m) & np.isfinite(layers_m)
                gain = gain + np.where(shown, np.asarray(factors), 0)
            return depth_m, gain

        return self._in_all_frames(states[:, :7], in_frame)

    def shown_solids(self, states: NDArray[np.float64], is_round: NDArray[np.bool_]) -> Shown:
        """Depth and log gain (n, X) of solids (n, 10): world_from_solid and logs of half sizes."""

        def in_frame(frame: int, in_camera: NDArray[np.float64]) -> Shown:
            window = self.compared.views[frame].window
            given = in_camera, solid_half_sizes(states), is_round
            return layer_gains(
                self.compared.densities[frame], solid_layers(window.camera, *given, *window.depth_m.shape)
            )

        return self._in_all_frames(states[:, :7], in_frame)

    def _in_all_frames(
        self,
        poses: NDArray[np.float64],
        in_frame: Callable[[int, NDArray[np.float64]], Shown],
    ) -> Shown:
        world_from_box, parts = matrices_of(poses), []
        for frame, camera_from_world in enumerate(self.compared.camera_from_world):
            parts.append(in_frame(frame, poses_of(camera_from_world @ world_from_box)))
        shown = [tuple(part.reshape(len(poses), -1) for part in one) for one in parts]
        if len(shown) == 1:
            return shown[0]
        depth_m, gain = (np.concatenate(leaves, axis=1) for leaves in zip(*shown, strict=True))
        return depth_m, gain


def nearest_shown(depth_m: NDArray[np.float32], log_gain: NDArray[np.float32]) -> Shown:
    """Depth and log gain (X,) of the nearest of layers (L, X), one or more; of equal ones the first."""
    nearest = depth_m.argmin(axis=0)[None]
    depth_m, log_gain = (np.take_along_axis(part, nearest, axis=0)[0] for part in (depth_m, log_gain))
    return depth_m, log_gain


def gain_before(shown: Shown, front: Shown) -> NDArray[np.float64]:
    """What each of some layers adds (n,) to the log likelihood of others, hidden where these are nearer.

    Args:
        shown: of the layers (n, X), each alone.
        front: of the others (X,) or (n, X), +inf and 0 where there are none.
    """
    (depth_m, gain), (front_m, front_gain) = shown, front
    return np.where(depth_m < front_m, gain - front_gain, 0.0).sum(axis=1, dtype=np.float64)


def slot_layers(depth_m: NDArray[np.float32], log_gain: NDArray[np.float32]) -> SlotLayers:
    """Layers (K, X) of one slot where any of them shows anything."""
    pixels = np.flatnonzero(np.isfinite(depth_m).any(axis=0))
    return SlotLayers(
        pixels, np.ascontiguousarray(depth_m[:, pixels]), np.ascontiguousarray(log_gain[:, pixels])
    )


def candidates_of(
    frames: PresenceFrames,
    priors: PosePriors,
    states: NDArray[np.float64],
    shapes: NDArray[np.integer],
    is_round: NDArray[np.bool_],
    log_offered: NDArray[np.float64],
    log_hidden: NDArray[np.float64],
    before: Candidates | None,
    anew: NDArray[np.bool_],
) -> Candidates:
    """Candidates ready for moves.

    Args:
        frames: what is seen.
        priors: of poses.
        states: (N + U, K, 10) world_from_box and logs of half sizes, of N objects and then of U solids.
        shapes: (N + U, K) draws of their shapes; of solids without meaning.
        is_round: (U,) which of these are cylinders.
        log_offered: (N + U, K) log q.
        log_hidden: (N,).
        before: candidates of which slots that are not `anew` keep theirs.
        anew: (N + U,) which are.
    """
    asked, some = len(log_offered) - len(is_round), np.flatnonzero(anew)
    layers = {} if before is None else dict(enumerate(before.layers))
    layers |= zip(
        some.tolist(), _slots_shown(frames, some, states[some], shapes[some], is_round, asked), strict=True
    )
    log_sizes = priors.sizes.log_density(states[:asked, :, 7:], np.arange(asked))
    log_solids = log_sizes_density(states[asked:, :, 7:], is_round[:, None])
    half_m = np.concatenate([np.exp(states[:asked, :, 7:]), solid_half_sizes(states[asked:])])
    log_sizes = np.concatenate([log_sizes, log_solids])
    prior = priors.of(states[..., :7], half_m, log_sizes, asked)
    log_hidden = np.append(log_hidden, np.full(len(is_round), -np.inf))
    return Candidates([layers[slot] for slot in range(len(log_offered))], log_offered, prior, log_hidden)


def _slots_shown(
    frames: PresenceFrames,
    slots: NDArray[np.integer],
    states: NDArray[np.float64],
    shapes: NDArray[np.integer],
    is_round: NDArray[np.bool_],
    asked: int,
) -> list[SlotLayers]:
    """What slots (n,) show in states (n, K, 10); the first `asked` of all are objects, the rest solids."""
    count = states.shape[1]
    objects, solids = slots[slots < asked], slots[slots >= asked] - asked
    seen = []
    if len(objects):
        of_objects = states[: len(objects)].reshape(-1, 10), shapes[: len(objects)].ravel()
        seen.append(frames.shown(np.repeat(objects, count), *of_objects))
    if len(solids):
        rounds = np.repeat(is_round[solids], count)
        seen.append(frames.shown_solids(states[len(objects) :].reshape(-1, 10), rounds))
    return [
        slot_layers(*one)
        for part in seen
        for one in zip(*(leaf.reshape(-1, count, leaf.shape[1]) for leaf in part), strict=True)
    ]
