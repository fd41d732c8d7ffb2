"""Evidence of places, against sums over all scenes, and how tables of decoys are judged."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from pipeline.benchmarks.decoys import DecoyRow, decoy_figures, decoy_lines, true_box
from pipeline.benchmarks.place_evidence import laid_into, log_scenes
from recordings.truth import TrueObject
from scene.model.number_prior import BinomialNumber
from scene.objects.scene_object import scene_object
from tests.scene.presence import strips
from tests.scene.presence.test_toggling import log_density_and_likelihood
from tests.statistical import assert_mean

ROW = DecoyRow(table=0, kind="face", shape="box", there=True, presence=0.9, error_m=0.002, advantage=5.0)


@pytest.mark.parametrize("place", [0, 1, None])
def test_sums_over_scenes(place: int | None, seed: int) -> None:
    """The mean of 2,000 estimates is the sum over the scenes of bare strips in which a slot is taken."""
    kinds, number = np.array([0, 1]), BinomialNumber(0.5)
    observed_m = strips.BACKGROUND_M + 2 * strips.SIGMA_M * np.random.default_rng(seed).normal(
        size=strips.WIDTH
    )
    candidates = strips.candidates_at(observed_m, kinds, number, np.tile(np.arange(strips.PLACES), (2, 1)))
    scenes = strips.all_scenes(2)
    taken = scenes[:, 0] >= 0 if place == 0 else scenes[:, 1] >= 0 if place == 1 else scenes[:, 0] >= -1
    exact = logsumexp([log_density_and_likelihood(candidates, one)[0] for one in scenes[taken]])
    others = [one for one in (0, 1) if one != place]
    rng = np.random.default_rng(seed)

    found = [log_scenes(rng, candidates, others, place, 1) for _ in range(2000)]

    assert_mean(np.exp(np.array(found) - exact), 1.0, detectable=0.2)


def test_what_the_prior_excludes_has_no_evidence(seed: int) -> None:
    """A place of which no candidate may be there, as one deep below the table: -inf, and no error."""
    observed_m = np.full(strips.WIDTH, strips.BACKGROUND_M)
    places = np.tile(np.arange(strips.PLACES), (2, 1))
    candidates = strips.candidates_at(observed_m, np.array([0, 1]), BinomialNumber(0.5), places)
    candidates.prior.on_root[1] = 0.0
    rng = np.random.default_rng(seed)

    assert log_scenes(rng, candidates, [0], 1, 4) == -np.inf
    assert np.isfinite(log_scenes(rng, candidates, [0], None, 4))


def test_places_lie_in_a_decoy_and_touch_its_faces() -> None:
    """The corners of a smaller box stay within a larger one's, and reach one of its faces at least."""
    turned = np.eye(4)
    turned[:3, :3], turned[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.3, 0.1, 0.7]
    half_m, own_m = np.array([0.1, 0.12, 0.15]), np.array([0.03, 0.05, 0.08])
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.linalg.inv(turned) @ laid_into(turned, half_m, own_m)
    assert len(inside) == 24 * 26
    corners = (signs * own_m) @ np.swapaxes(inside[:, :3, :3], 1, 2) + inside[:, None, :3, 3]
    reach = np.abs(corners) / half_m
    assert (reach < 1 + 1e-9).all()
    np.testing.assert_allclose(reach.max(axis=(1, 2)), 1)


def test_the_true_box_is_where_the_mesh_is() -> None:
    """Of a box that is turned in its mesh's frame, corner by corner."""
    in_mesh, in_world, camera = np.eye(4), np.eye(4), np.eye(4)
    in_mesh[:3, :3] = Rotation.from_euler("z", 28, degrees=True).as_matrix()
    in_mesh[:3, 3] = 0.02, -0.01, 0.03
    in_world[:3, :3], in_world[:3, 3] = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), (0.1, 0.2, 0.3)
    camera[:3, :3], camera[:3, 3] = Rotation.from_rotvec([1.0, 0.3, 0.1]).as_matrix(), (0.0, -0.1, 0.8)
    mesh = trimesh.creation.box((0.11, 0.09, 0.035))
    mesh.apply_transform(in_mesh)
    sought = scene_object("box", mesh.vertices, mesh.faces)
    true = TrueObject(name="one", shape="box", world_from_object=in_world)
    corners_m = trimesh.bounds.corners(np.stack([-sought.half_extents_m, sought.half_extents_m]))

    found_m = trimesh.transform_points(corners_m, true_box(camera, true, sought))

    there_m = trimesh.transform_points(mesh.vertices, camera @ in_world)
    off_m, which = KDTree(there_m).query(found_m)
    assert off_m.max() < 1e-9
    assert len(np.unique(which)) == 8


def test_what_is_right() -> None:
    """Found where it is, or told absent where it is not; how far the truth is ahead counts by itself."""
    rows = [
        ROW,
        replace(ROW, error_m=0.02, advantage=-1.0),
        replace(ROW, there=False, error_m=1.0, presence=0.2),
        replace(ROW, there=False, error_m=1.0, presence=0.7, kind="block"),
    ]
    figures = decoy_figures(rows)["decoys"]
    assert (figures["all"]["right"]["count"], figures["all"]["truth_ahead"]["count"]) == (2, 3)
    assert (figures["face"]["tables"], figures["block"]["right"]["count"]) == (3, 0)
    assert figures["face"]["least_advantage"] == -1.0
    assert "carrier" not in figures
    assert len(decoy_lines(decoy_figures(rows))) == 4
