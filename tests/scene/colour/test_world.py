"""Kinds stand on the table, know their symmetry, and are rendered and shaded as they stand."""

import numpy as np
import pytest
import trimesh

from pipeline.synthesis.air import air_meshes, air_world, photograph
from scene.colour.posterior import Scene, seen_together
from scene.colour.rendering import SAMPLES, render
from scene.colour.world import Kind


def test_turns_are_those_of_the_shapes() -> None:
    """Round, fourfold, twofold, a mug that looks the same only after a whole turn, about its body's axis."""
    kinds = {name: Kind.standing(name, mesh) for name, mesh in air_meshes().items()}
    kinds["brick"] = Kind.standing("brick", trimesh.creation.box((0.2, 0.1, 0.05)))

    assert {name: kind.turns for name, kind in kinds.items()} == {
        "ball": 0,
        "cube": 4,
        "cylinder": 0,
        "mug": 1,
        "brick": 2,
    }
    for kind in kinds.values():
        assert kind.vertices_m[:, 2].min() == pytest.approx(0)
    body = kinds["mug"].vertices_m[:, :2]
    assert np.linalg.norm(body, axis=1).max() > 0.06  # the handle
    assert np.median(np.linalg.norm(body[kinds["mug"].vertices_m[:, 2] < 1e-4], axis=1)) == pytest.approx(
        0.042, abs=5e-4
    )
    np.testing.assert_allclose(kinds["brick"].middle_m, 0, atol=1e-12)


def test_renderings_are_what_embree_sees(seed: int) -> None:
    """Within 1/255 on 99% of inner pixels: those whose neighbours belong to the same thing."""
    world = air_world(96, 96)
    rng = np.random.default_rng(seed)
    inner, alike = 0, 0
    for kind in range(len(world.kinds)):
        kinds = np.array([kind, (kind + 1) % 4])
        yaw = np.where(world.spins[kinds], 0.0, rng.uniform(0, 6, 2))  # round things are rendered so
        scene = Scene(kinds, np.column_stack([[-0.05, 0.06], rng.uniform(-0.05, 0.05, 2), yaw]))
        albedo = np.array([[0.9, 0.6, 0.3], [0.2, 0.7, 1.0]])
        picture, _ = photograph(world, scene, albedo, subsamples=SAMPLES)
        layers = render(world, scene.kinds, scene.poses)
        view = seen_together(world, layers)
        whole = view.share > 0.999
        owner = np.full(96 * 96, -1)
        owner[layers.pixel[whole]] = layers.owner[whole]
        ours = np.zeros((96 * 96, 3))
        ours[layers.pixel[whole]] = (layers.shade[:, None] * albedo[layers.owner])[whole]
        square = np.pad(owner.reshape(96, 96), 1, constant_values=-2)
        windows = np.lib.stride_tricks.sliding_window_view(square, (3, 3)).reshape(96 * 96, 9)
        within = ((windows == owner[:, None]).all(axis=1)) & (owner >= 0)
        inner += within.sum()
        alike += (np.abs(ours - picture.reshape(-1, 3)).max(axis=1) <= 1 / 255)[within].sum()

    assert inner > 800
    assert alike >= 0.99 * inner
