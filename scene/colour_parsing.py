"""`parse` without depth: things that stand upright on a known table, from one colour image.

The search of `scene.colour` finds number, kinds and poses; chains on the exact posterior over scenes and
lamps tell how sure they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from scene.colour.camera_view import pooled_image, square_in_view
from scene.colour.density import ColourNoise
from scene.colour.lattice import Lattice
from scene.colour.light import LampShares
from scene.colour.posterior import ColourImage, View, colour_image, seen_together, visible_gain
from scene.colour.rendering import render
from scene.colour.scene_samples import SceneSamples, sampled
from scene.colour.search import find, find_under_any_lamp
from scene.colour.surroundings import Surroundings
from scene.colour.weighing import FoundScene
from scene.colour.world import Kind, Light, TableWorld
from scene.config import ParseConfig
from scene.copies import slot_names
from scene.model.contact import TOP_FACE
from scene.model.scene_graph import ROOT
from scene.result import SceneResult
from scene.summary import pose_modes, second_moment
from shapes.geometry.poses import matrices_of, poses_of

BOTTOM_FACE = 4
"""Face -z of `scene.result.FACES`: a thing's own bottom rests on the top of the table."""


def parse_colour(
    seed: int,
    rgb: NDArray[np.uint8],
    camera: CameraIntrinsics,
    camera_from_world: NDArray[np.float64],
    kinds: Sequence[Kind],
    frame: int,
    config: ParseConfig,
) -> tuple[SceneResult, float]:
    """The scene that one colour image shows, and the share of the image that it does not explain.

    Args:
        seed: of the samples.
        rgb: (H, W, 3).
        camera: of the image.
        camera_from_world: (4, 4), the table's top z = 0; see `scene.colour.camera_view`.
        kinds: of things, which stand on the table with their own z up.
        frame: number of the frame in the recording.
        config: settings.

    Raises:
        ValueError: hardly any of the table is in view.
    """
    image, pooled = pooled_image(rgb, camera, config.gamma)
    world = TableWorld(
        camera=pooled,
        camera_from_world=camera_from_world,
        kinds=tuple(kinds),
        half_m=square_in_view(pooled, camera_from_world),
        most=config.most,
        light=_light(config),
        noise=ColourNoise(),
    )
    lattice = Lattice.of(world)
    if config.light:
        found, lamps = find(lattice, image), LampShares.known(world.light)
    else:
        lattice, found, lamps = find_under_any_lamp(lattice, image)
    world, seen = lattice.world, colour_image(lattice.world, image)
    rng = np.random.default_rng(seed)
    samples = sampled(rng, world, seen, found, lamps, config.sweeps, config.chains)
    strange_share = float((Surroundings.of(world, seen, [found.best.scene]).excess > 0).mean())
    return _summary(world, seen, found, samples, frame), strange_share


def _light(config: ParseConfig) -> Light:
    """The user's, else one from where a search can begin."""
    if not config.light:
        return Light()
    x, y, z, ambient = config.light
    return Light(direction=(x, y, z), ambient=ambient)


def _summary(
    world: TableWorld, image: ColourImage, found: FoundScene, samples: SceneSamples, frame: int
) -> SceneResult:
    """In the camera and in the meshes' own frames; copies that were not found stand at the origin."""
    names = [kind.name for kind in world.kinds]
    slots = slot_names(names, world.most)
    count, kept, chains = len(slots), len(samples.poses), len(samples.kinds)
    taken = _slots_of(found.best.scene.kinds, world.most)
    boxes = np.tile(world.camera_from_world, (kept, count, 1, 1))
    boxes[:, taken] = world.camera_from_world @ _standing(samples.poses)
    modes = [pose_modes(boxes[:, one]) for one in range(count)]
    bases = np.tile(np.eye(4), (count, 1, 1))
    bases[:, :3, 3] = np.repeat([-kind.base_m for kind in world.kinds], world.most, axis=0)
    means = np.stack([one.centres[0] for one in modes]) @ bases
    poses = boxes @ bases
    edges, faces = np.zeros((count, count + 1)), np.full((count, count + 1, 2), -1, np.int32)
    edges[taken, count], faces[taken, count] = 1.0, (BOTTOM_FACE, TOP_FACE)
    parents = np.full((kept, count), ROOT, np.int32)
    parents[:, taken] = count
    shown, nats = np.zeros(count), np.zeros(count)
    best = found.best.scene
    view = seen_together(world, render(world, best.kinds, best.poses))
    shown[taken], nats[taken] = _visible_share(view), visible_gain(world, image, view)
    numbers = [(kind, copy + 1) for kind in range(len(names)) for copy in range(world.most)]
    shares = np.array([samples.at_least(*one) for one in numbers])
    return SceneResult(
        names=np.array(slots),
        frames=np.array([frame], np.int64),
        camera_from_object=means,
        covariance=np.stack([second_moment(poses[:, one], means[one]) for one in range(count)]),
        most_probable=poses[int(samples.log_posterior.argmax())],
        presence=shares.mean(axis=1),
        presence_std=shares.std(axis=1, ddof=int(chains > 1)) / np.sqrt(chains),
        hidden_presence=np.zeros(len(slots)),
        number_probabilities=_numbers(shares.mean(axis=1).reshape(-1, world.most)),
        hidden_share=np.zeros(len(slots)),
        hidden_poses=np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(slots), 1, 1)),
        visible_fraction=shown,
        colour_nats=nats,
        mode_poses=np.stack([one.centres for one in modes]) @ bases[:, None],
        mode_probabilities=np.stack([one.shares for one in modes]),
        sample_modes=np.stack([one.labels for one in modes], axis=1),
        edge_probabilities=edges,
        edge_faces=faces,
        sample_poses=poses_of(poses),
        sample_parents=parents,
        sample_log_posteriors=samples.log_posterior,
        chain=np.tile(np.arange(chains, dtype=np.int32), kept // chains),
        acceptance=np.asarray(samples.moved),
        log_estimate_variance=np.asarray(0.0),
    )


def _numbers(at_least: NDArray[np.float64]) -> NDArray[np.float64]:
    """Probabilities (K M, K M + 1) of so many things of each kind, from those of 1 to M at least (K, M)."""
    kinds, most = at_least.shape
    told = np.zeros((kinds, kinds * most + 1))
    told[:, : most + 1] = -np.diff(at_least, axis=1, prepend=1.0, append=0.0)
    return np.repeat(told, most, axis=0)


def _slots_of(kinds: NDArray[np.int64], copies: int) -> list[int]:
    """The slot of each thing: the first free copy of its kind."""
    return [kind * copies + kinds[:place].tolist().count(kind) for place, kind in enumerate(kinds.tolist())]


def _standing(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """World from thing (..., 4, 4) of (x, y, yaw) (..., 3)."""
    half = poses[..., 2] / 2
    zero = np.zeros(half.shape)
    turn = [np.cos(half), zero, zero, np.sin(half)]
    return matrices_of(np.stack([*turn, poses[..., 0], poses[..., 1], zero], axis=-1))


def _visible_share(view: View) -> NDArray[np.float64]:
    """Share (T,) of what each thing fills that nothing nearer hides."""
    owner, count = view.layers.owner, len(view.layers.kinds)
    alone = np.bincount(owner, view.layers.fill, minlength=count)
    return np.bincount(owner, view.share, minlength=count) / np.maximum(alone, 1.0)
