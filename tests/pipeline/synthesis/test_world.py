"""The ray caster sees what an independent projection says."""

import numpy as np
import open3d as o3d
import trimesh

from pipeline.synthesis.colours import shape_colour
from pipeline.synthesis.paint import COLOURS, painted
from pipeline.synthesis.visibility import pixel_counts, silhouette
from pipeline.synthesis.world import NOTHING, Part, RayCaster, pixel_directions
from recordings.types import CameraIntrinsics

LENS = CameraIntrinsics(width=64, height=48, fx=61.3, fy=59.1, cx=30.2, cy=25.7)


def part(mesh: trimesh.Trimesh, offset_m: tuple[float, float, float] = (0, 0, 0)) -> Part:
    """A mesh moved by an offset."""
    return Part(name="part", mesh=mesh, world_from_part=trimesh.transformations.translation_matrix(offset_m))


def test_a_straight_edge_falls_on_the_projected_pixel_to_a_hundredth() -> None:
    """A pixel is covered exactly if its integer centre lies beyond u = fx x / z + cx."""
    depth_m, column = 1.7, 41
    for error_px in (-0.01, 0.01):
        edge_m = (column + error_px - LENS.cx) * depth_m / LENS.fx
        plate = trimesh.creation.box((10, 10, 1e-6))
        view = RayCaster([part(plate, (edge_m + 5, 0, depth_m))]).view(LENS, np.eye(4))

        covered = np.isfinite(view.depth_m)
        assert covered[:, column].all() == (error_px < 0)
        assert covered[:, column + 1].all()
        assert not covered[:, column - 1].any()


def test_a_level_edge_falls_on_the_projected_pixel_to_a_hundredth() -> None:
    """The same along the image's rows."""
    depth_m, row = 0.8, 17
    for error_px in (-0.01, 0.01):
        edge_m = (row + error_px - LENS.cy) * depth_m / LENS.fy
        plate = trimesh.creation.box((10, 10, 1e-6))
        view = RayCaster([part(plate, (0, edge_m + 5, depth_m))]).view(LENS, np.eye(4))

        assert np.isfinite(view.depth_m[row]).all() == (error_px < 0)


def test_rays_are_open3ds_with_half_a_pixel_added_to_the_principal_point() -> None:
    """Open3D's pinhole rays go through u + 0.5."""
    matrix = np.array([[LENS.fx, 0, LENS.cx + 0.5], [0, LENS.fy, LENS.cy + 0.5], [0, 0, 1]])
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        o3d.core.Tensor.from_numpy(matrix), o3d.core.Tensor.from_numpy(np.eye(4)), LENS.width, LENS.height
    ).numpy()

    np.testing.assert_allclose(rays[..., 3:] / rays[..., 5:], pixel_directions(LENS), atol=1e-6)


def test_depth_is_measured_along_the_optical_axis() -> None:
    """A plane across the axis has one depth, whatever the ray's obliqueness, seen from a turned camera."""
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    wall = Part(
        name="wall", mesh=trimesh.creation.box((20, 20, 0.1)), world_from_part=turn @ np.diag([1, 1, 1, 1])
    )
    camera = turn @ trimesh.transformations.translation_matrix((0.3, 0.1, -2.0))
    view = RayCaster([wall]).view(LENS, camera)

    np.testing.assert_allclose(view.depth_m, 1.95, atol=1e-5)
    rays = pixel_directions(LENS)
    np.testing.assert_allclose(view.cos_incidence, 1 / np.linalg.norm(rays, axis=-1), atol=1e-5)


def test_rays_that_meet_nothing_are_infinite() -> None:
    """Infinite depth and no part."""
    view = RayCaster([part(trimesh.creation.box((0.2, 0.2, 0.2)), (0, 0, 2))]).view(LENS, np.eye(4))

    assert (np.isinf(view.depth_m) == (view.part == NOTHING)).all()
    assert view.part[25, 30] == 0
    assert view.part[0, 0] == NOTHING


def test_visible_fraction_counts_what_hides_and_what_the_image_cuts_off() -> None:
    """Half behind a screen is a half, half outside the image too, behind the camera is nothing."""
    square = trimesh.creation.box((0.4, 0.4, 0.001))
    screen = part(trimesh.creation.box((1, 1, 0.001)), (0.5, 0, 1.9))

    def visible(offset_m: tuple[float, float, float], *others: Part) -> float:
        parts = [part(square, offset_m), *others]
        shown = RayCaster(parts).view(LENS, np.eye(4)).part == 0
        return pixel_counts(silhouette(parts[0], LENS, np.eye(4)), shown).visible_fraction

    assert visible((0, 0, 2)) == 1
    assert abs(visible((0, 0, 2), screen) - 0.5) < 0.06
    assert abs(visible(((63.5 - LENS.cx) * 2 / LENS.fx, 0, 2)) - 0.5) < 0.06
    assert visible((0, 0, -2)) == 0


def test_painted_things_show_their_own_colours() -> None:
    """A plate's halves are seen on their own sides, and a flat part keeps its colour; nothing is black."""
    plate = painted("plate", trimesh.creation.box((0.4, 0.4, 0.1)), "halves")
    behind = Part(
        name="wall",
        mesh=trimesh.creation.box((4, 4, 0.1)),
        world_from_part=trimesh.transformations.translation_matrix((1.9, 0, 2)),
        colour=(10, 20, 30),
    )
    view = RayCaster([part(plate, (0, 0, 1)), behind]).view(LENS, np.eye(4))
    ground, other = (shape_colour("plate" + words) for words in COLOURS[:2])
    assert np.allclose(view.rgb[18, 30], ground, atol=1)
    assert np.allclose(view.rgb[34, 30], other, atol=1)
    assert np.allclose(view.rgb[view.part == 1], (10, 20, 30))
    assert (view.rgb[view.part == NOTHING] == 0).all()
    assert (view.part == NOTHING).any()
