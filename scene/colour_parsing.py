"""`parse` without depth: things that stand upright on a known table, from one colour image.

The search of `scene.colour` finds number, kinds and poses; Metropolis chains on the exact posterior tell how
sure the poses are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from scene.colour.camera_view import pooled_image, square_in_view
from scene.colour.density import ColourNoise
from scene.colour.light import most_probable_light
from scene.colour.posterior import ColourImage, Scene, colour_image, log_posterior, visible
from scene.colour.search import FoundScene, Searcher, Weighed
from scene.colour.world import Kind, Light, TableWorld, render
from scene.config import ParseConfig
from scene.copies import slot_names
from scene.model.scene_graph import ROOT
from scene.result import SceneResult
from scene.summary import MODES, pose_modes, second_moment
from shapes.geometry.poses import matrices_of, poses_of

STEPS = (0.2, 0.6, 2.0)
"""Of proposals, in standard deviations by curvature: pixels make the posterior rough within one."""
LEAST = 0.1
"""Share of the curvature's standard deviations that a taught proposal keeps in directions not yet visited."""
STRANGE_NATS = 8.0
"""Below the density of the table's own colour: four standard deviations in one channel."""
BOTTOM, TOP = 4, 5
"""Faces -z and +z of `scene.result.FACES`: a thing's own bottom rests on the top of the table."""


@dataclass(frozen=True, eq=False)
class _Samples:
    """Of the best scene's poses.

    Attributes:
        poses: (S, T, 3) of the T things found, all chains of a sweep after each other.
        log_posterior: (S,).
        accepted: share of moves.
        chains: how many.
    """

    poses: NDArray[np.float64]
    log_posterior: NDArray[np.float64]
    accepted: float
    chains: int


def parse_colour(
    seed: int,
    rgb: NDArray[np.uint8],
    camera: CameraIntrinsics,
    camera_from_world: NDArray[np.float64],
    shapes: Mapping[str, trimesh.Trimesh],
    frame: int,
    config: ParseConfig,
) -> tuple[SceneResult, float]:
    """The scene that one colour image shows, and the share of the image that is neither table nor thing.

    Args:
        seed: of the samples.
        rgb: (H, W, 3).
        camera: of the image.
        camera_from_world: (4, 4), the table's top z = 0; see `scene.colour.camera_view`.
        shapes: meshes by name, which stand on the table with their own z up.
        frame: number of the frame in the recording.
        config: settings.

    Raises:
        ValueError: hardly any of the table is in view.
    """
    image, pooled = pooled_image(rgb, camera, config.gamma)
    kinds = tuple(Kind.standing(name, mesh) for name, mesh in shapes.items())
    world = TableWorld(
        camera=pooled,
        camera_from_world=camera_from_world,
        kinds=kinds,
        half_m=square_in_view(pooled, camera_from_world),
        most=config.most,
        light=_light(config),
        noise=ColourNoise(),
    )
    found = Searcher.of(world).find(image)
    if not config.light and len(found.best.scene):
        light = most_probable_light(world, colour_image(world, image), found.best.scene)
        if light != world.light:
            world = replace(world, light=light)
            found = Searcher.of(world).find(image)
    seen = colour_image(world, image)
    samples = _sample(np.random.default_rng(seed), world, seen, found.best, config)
    return _summary(world, found, samples, frame), _strange_share(world, seen, found.best.scene)


def _light(config: ParseConfig) -> Light:
    """The user's, else one from where a search can begin."""
    if not config.light:
        return Light()
    x, y, z, ambient = config.light
    return Light(direction=(x, y, z), ambient=ambient)


def _sample(
    rng: np.random.Generator, world: TableWorld, image: ColourImage, best: Weighed, config: ParseConfig
) -> _Samples:
    """Metropolis chains from round the best scene: in a sweep each thing is moved once (Metropolis 1953).

    Number and kinds stay as they were found. The first third teaches every thing's proposal its covariance
    and is dropped. The yaw of a round thing is drawn from the prior.
    """
    things, burn_in = len(best.scene), config.sweeps // 3
    kept = config.sweeps - burn_in
    round_ones = [world.kinds[kind].turns == 0 for kind in best.scene.kinds]
    sd = best.sd * ~np.stack([np.zeros(things, np.bool_)] * 2 + [np.array(round_ones, np.bool_)], axis=1)
    poses = np.empty((kept, config.chains, things, 3))
    values, accepted = np.empty((kept, config.chains)), 0
    for chain in range(config.chains):
        state, value = best.scene.poses, best.log_density
        roots, visited = np.stack([np.diag(one) for one in sd]) if things else np.zeros((0, 3, 3)), []
        for sweep in range(config.sweeps):
            if sweep == burn_in and things:
                roots = _roots(np.array(visited), sd)
            for one in range(things):
                offered = state.copy()
                offered[one] += rng.choice(STEPS) * roots[one] @ rng.standard_normal(3)
                there = log_posterior(world, image, Scene(best.scene.kinds, offered))
                if np.log(rng.random()) < there - value:
                    state, value, accepted = offered, there, accepted + 1
            if sweep < burn_in:
                visited.append(state)
            else:
                poses[sweep - burn_in, chain], values[sweep - burn_in, chain] = state, value
    poses[..., round_ones, 2] = rng.uniform(0, 2 * np.pi, (kept, config.chains, sum(round_ones)))
    share = accepted / max(config.chains * config.sweeps * things, 1)
    return _Samples(poses.reshape(-1, things, 3), values.ravel(), share, config.chains)


def _roots(visited: NDArray[np.float64], sd: NDArray[np.float64]) -> NDArray[np.float64]:
    """Roots (T, 3, 3) of the covariances of each thing's poses (S, T, 3), no narrower than a part of `sd`."""
    apart = visited - visited.mean(axis=0)
    covariance = np.einsum("sti,stj->tij", apart, apart) / max(len(visited), 1)
    least = (LEAST * np.maximum(sd, sd[sd > 0].min(initial=1.0))) ** 2
    return np.linalg.cholesky(covariance + least[:, None] * np.eye(3))


def _summary(world: TableWorld, found: FoundScene, samples: _Samples, frame: int) -> SceneResult:
    """In the camera and in the meshes' own frames; copies that were not found stand at the origin."""
    names = [kind.name for kind in world.kinds]
    slots = slot_names(names, world.most)
    count, kept = len(slots), len(samples.poses)
    taken = _slots_of(found.best.scene.kinds, world.most)
    boxes = np.tile(world.camera_from_world, (kept, count, 1, 1))
    boxes[:, taken] = world.camera_from_world @ _standing(samples.poses)
    modes = [pose_modes(boxes[:, one]) for one in range(count)]
    bases = np.tile(np.eye(4), (count, 1, 1))
    bases[:, :3, 3] = np.repeat([-kind.base_m for kind in world.kinds], world.most, axis=0)
    means = np.stack([one.centres[0] for one in modes]) @ bases
    poses = boxes @ bases
    edges, faces = np.zeros((count, count + 1)), np.full((count, count + 1, 2), -1, np.int32)
    edges[taken, count], faces[taken, count] = 1.0, (BOTTOM, TOP)
    parents = np.full((kept, count), ROOT, np.int32)
    parents[:, taken] = count
    shown = np.zeros(count)
    shown[taken] = _visible_share(world, found.best.scene)
    numbers = [(kind, copy + 1) for kind in range(len(names)) for copy in range(world.most)]
    return SceneResult(
        names=np.array(slots),
        frames=np.array([frame], np.int64),
        camera_from_object=means,
        covariance=np.stack([second_moment(poses[:, one], means[one]) for one in range(count)]),
        most_probable=poses[int(samples.log_posterior.argmax())],
        presence=np.array([found.at_least(*one) for one in numbers]),
        presence_std=np.zeros(len(slots)),
        hidden_share=np.zeros(len(slots)),
        hidden_poses=np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(slots), 1, 1)),
        visible_fraction=shown,
        mode_poses=np.stack([one.centres for one in modes]) @ bases[:, None],
        mode_probabilities=np.stack([one.shares for one in modes]).reshape(count, MODES),
        sample_modes=np.stack([one.labels for one in modes], axis=1),
        edge_probabilities=edges,
        edge_faces=faces,
        sample_poses=poses_of(poses),
        sample_parents=parents,
        sample_log_posteriors=samples.log_posterior,
        chain=np.tile(np.arange(samples.chains, dtype=np.int32), kept // samples.chains),
        acceptance=np.asarray(samples.accepted),
        log_estimate_variance=np.asarray(0.0),
    )


def _strange_share(world: TableWorld, image: ColourImage, scene: Scene) -> float:
    """Share of the pixels that show another colour than the table's where no thing is."""
    usual = image.colour.shape[1] * np.log(1 / (world.noise.sigma * np.sqrt(2 * np.pi)))
    strange = image.table < usual - STRANGE_NATS
    strange[render(world, scene.kinds, scene.poses).pixel] = False
    return float(strange.mean())


def _slots_of(kinds: NDArray[np.int64], copies: int) -> list[int]:
    """The slot of each thing: the first free copy of its kind."""
    return [kind * copies + kinds[:place].tolist().count(kind) for place, kind in enumerate(kinds.tolist())]


def _standing(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """World from thing (..., 4, 4) of (x, y, yaw) (..., 3)."""
    half = poses[..., 2] / 2
    zero = np.zeros(half.shape)
    turn = [np.cos(half), zero, zero, np.sin(half)]
    return matrices_of(np.stack([*turn, poses[..., 0], poses[..., 1], zero], axis=-1))


def _visible_share(world: TableWorld, scene: Scene) -> NDArray[np.float64]:
    """Share (T,) of each thing's pixels that nothing nearer hides."""
    layers = render(world, scene.kinds, scene.poses)
    alone, seen = np.diff(layers.start), np.diff(visible(world, layers).start)
    return seen / np.maximum(alone, 1)
