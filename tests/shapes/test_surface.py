import numpy as np
import pytest
import trimesh

from shapes.surface import SurfaceMesh, level_surface


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
