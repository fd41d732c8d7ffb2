import numpy as np
import pytest
import trimesh
from open3d.t.geometry import RaycastingScene  # pyright: ignore[reportMissingImports]

from shapes.surface import SurfaceMesh, level_surface
from shapes.surfels import Surfels
from tests.shapes.views import embree, tensor


def as_trimesh(surface: SurfaceMesh) -> trimesh.Trimesh:
    """The surface as it is, nothing merged or repaired."""
    return trimesh.Trimesh(surface.vertices_m, surface.triangles, process=False)


def ball(radius: float, size: int = 24) -> np.ndarray:
    """Distances inside a ball, turned into probabilities that cross 0.5 on its surface."""
    centre = (size - 1) / 2
    i, j, k = np.mgrid[:size, :size, :size] - centre
    return np.clip(0.5 + 0.5 * (radius - np.sqrt(i**2 + j**2 + k**2)), 0, 1)


def test_surface_of_a_ball_is_closed_outward_and_has_its_volume() -> None:
    """Volume and centre agree with the ball to what a lattice of this size can hold."""
    mesh = as_trimesh(level_surface(ball(8.0), 0.5, 0.005))

    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * (8 * 0.005) ** 3, rel=0.02)
    np.testing.assert_allclose(mesh.center_mass, 12 * 0.005, atol=1e-6)


@pytest.mark.parametrize("level", [0.1, 0.5, 0.9])
def test_every_surface_is_closed_and_outward(seed: int, level: float) -> None:
    """Random probabilities, certain voxels and voxels exactly on the level, up to the grid's edge."""
    generator = np.random.default_rng(seed)
    for share in (0.05, 0.3, 0.5, 0.7, 0.95):
        binary = generator.random((7, 6, 9)) < share
        for field in (binary.astype(float), generator.random((7, 6, 9)), np.where(binary, level, 1.0)):
            mesh = as_trimesh(level_surface(field, level, 0.005))

            assert mesh.is_watertight
            assert mesh.is_winding_consistent
            assert mesh.volume > 0
            assert mesh.area_faces.min() > 0


def test_shells_are_nested() -> None:
    """A higher level never encloses more."""
    volumes = [as_trimesh(level_surface(ball(8.0), level, 0.005)).volume for level in (0.1, 0.5, 0.9)]

    assert volumes == sorted(volumes, reverse=True)


def test_vertices_take_the_colour_of_the_voxel_inside() -> None:
    """Two neighbours of different colours keep them on the faces that only one of them has."""
    occupancy = np.zeros((4, 3, 3))
    occupancy[1:3, 1, 1] = 1.0
    rgb = np.zeros((4, 3, 3, 3), np.uint8)
    rgb[1, 1, 1], rgb[2, 1, 1] = (255, 0, 0), (0, 0, 255)

    surface = level_surface(occupancy, 0.5, 1.0, rgb)

    assert surface.rgb is not None
    left, right = surface.vertices_m[:, 0].argmin(), surface.vertices_m[:, 0].argmax()
    np.testing.assert_array_equal(surface.rgb[[left, right]], [(255, 0, 0), (0, 0, 255)])
    assert {tuple(colour) for colour in surface.rgb.tolist()} == {(255, 0, 0), (0, 0, 255)}


def test_nothing_above_the_level_is_the_callers_mistake() -> None:
    """An empty grid has no surface, and a level outside (0, 1) separates nothing."""
    with pytest.raises(ValueError, match="no surface"):
        level_surface(np.full((3, 3, 3), 0.5), 0.5, 0.005)
    with pytest.raises(ValueError, match="between 0 and 1"):
        level_surface(np.ones((3, 3, 3)), 1.0, 0.005)


def wall(thickness: float, place: float, normal: np.ndarray, size: int = 12) -> tuple[np.ndarray, Surfels]:
    """Voxels whose centre a wall holds, and the surfels of both its sides beside the voxels; in voxels.

    The wall is a disc about the middle of the grid, three voxels from its border.
    """
    centres = np.argwhere(np.ones((size,) * 3)) + 0.5 - size / 2
    height = centres @ normal - place
    across = np.linalg.norm(centres - np.outer(centres @ normal, normal), axis=1)
    offset = np.stack([thickness / 2 - height, thickness / 2 + height], axis=1)
    known = (np.abs(offset).max(axis=1) < 2.0) & (across < size / 2 - 3)
    inside = (offset.min(axis=1) > 0) & (across < size / 2 - 3)
    surfels = Surfels(
        voxel=np.repeat(np.flatnonzero(known), 2).astype(np.int32),
        offset_m=offset[known].ravel().astype(np.float32),
        sigma_m=np.full(2 * int(known.sum()), 0.05, np.float32),
        normal=np.tile(np.stack([normal, -normal]), (int(known.sum()), 1)).astype(np.float32),
    )
    return inside.reshape((size,) * 3).astype(float), surfels


@pytest.mark.parametrize("thickness", [0.1, 0.25, 0.6, 1.2])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0, 0.8), (0.577, 0.577, 0.578)])
def test_a_wall_is_drawn_as_thick_as_its_surfels_say(thickness: float, normal: tuple, seed: int) -> None:
    """Wherever it lies between the voxels; one thinner than a fifth of them as thick as that."""
    generator = np.random.default_rng(seed)
    direction = np.array(normal) / np.linalg.norm(normal)
    for place in (0.03, 0.27, 0.5):
        inside, surfels = wall(thickness, place, direction)
        inside[0, 0, 0] = 1  # a voxel elsewhere

        mesh = as_trimesh(level_surface(inside, 0.5, 1.0, surfels=surfels))

        assert mesh.is_watertight
        around = np.linalg.svd(direction[None])[2][1:]
        starts = 6 + generator.uniform(-1, 1, (100, 2)) @ around + 3 * direction
        scene = embree(mesh)
        first = cast(scene, starts, -direction)
        second = first + 1e-4 + cast(scene, starts - (first[:, None] + 1e-4) * direction, -direction)
        drawn = max(thickness, 1.25 / 6)
        right = np.abs(3 - first - place - drawn / 2) < 0.01
        right &= np.abs(3 - second - place + drawn / 2) < 0.01
        assert right.mean() > 0.98


def cast(scene: RaycastingScene, starts: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distances (N,) from the starts (N, 3) to the surface in one direction."""
    rays = np.concatenate([starts, np.tile(direction, (len(starts), 1))], axis=1)
    return scene.cast_rays(tensor(rays.astype(np.float32)))["t_hit"].numpy()


def test_a_gap_between_two_walls_does_not_hollow_them() -> None:
    """Surfels that face each other across half a voxel of free space leave what is behind them solid."""
    occupancy = np.ones((4, 4, 8))
    voxels = np.ravel_multi_index(np.array([[1, 1, 1, 1], [2, 2, 2, 2], [3, 3, 4, 4]]), occupancy.shape)
    surfels = Surfels(
        voxel=np.asarray(voxels, np.int32),
        offset_m=np.array([0.3, -0.8, -0.7, 0.2], np.float32),  # below 3.8 and above 4.3
        sigma_m=np.full(4, 0.02, np.float32),
        normal=np.array([[0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, -1]], np.float32),
    )

    assert as_trimesh(level_surface(occupancy, 0.5, 1.0, surfels=surfels)).body_count == 1


def test_surfels_place_a_surface_and_tell_how_well() -> None:
    """A ball on whole voxels is rounded to a hundredth of one; a level of 0.9 lies 1.28 deviations deeper."""
    radius, size = 6.3, 18
    centres = np.argwhere(np.ones((size,) * 3)) + 0.5 - size / 2
    distance = np.linalg.norm(centres, axis=1)
    near = np.flatnonzero(np.abs(distance - radius) < 1.5)
    surfels = Surfels(
        voxel=near.astype(np.int32),
        offset_m=(radius - distance[near]).astype(np.float32),
        sigma_m=np.full(len(near), 0.1, np.float32),
        normal=(centres[near] / distance[near, None]).astype(np.float32),
    )
    occupancy = (distance < radius).reshape((size,) * 3).astype(float)

    for level, depth in ((0.5, 0.0), (0.9, 0.1282)):
        surface = level_surface(occupancy, level, 1.0, surfels=surfels)
        from_centre = np.linalg.norm(surface.vertices_m - size / 2, axis=1)
        np.testing.assert_allclose(from_centre, radius - depth, atol=0.06)
        np.testing.assert_allclose(surface.sigma_m, 0.1, rtol=1e-3)
    assert np.isinf(level_surface(occupancy, 0.5, 1.0).sigma_m).all()
