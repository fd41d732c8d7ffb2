import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from shapes.prior import ShapePrior, SurfaceState, VoxelState
from shapes.surfels import Surfels
from tests.statistical import assert_mean

SHAPE = (4, 3, 5)


def surfels(
    voxel: Sequence[int] = (3,), offset_m: float = 0.001, sigma_m: float = 0.0003, length: float = 1.0
) -> Surfels:
    """Alike surfels at these voxels."""
    count = len(voxel)
    return Surfels(
        voxel=np.array(voxel, np.int32),
        offset_m=np.full(count, offset_m, np.float32),
        sigma_m=np.full(count, sigma_m, np.float32),
        normal=np.tile(np.array([0, length, 0], np.float32), (count, 1)),
    )


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"voxel": [1, 1, 1]}, "order of voxels, at most 2"),
        ({"voxel": [2, 1]}, "order of voxels"),
        ({"offset_m": np.nan}, "not finite"),
        ({"sigma_m": 0.0}, "not positive"),
        ({"length": 0.5}, "length 1"),
    ],
)
def test_values_that_are_no_surfels_are_refused(values: dict, message: str) -> None:
    """None can be made that means nothing."""
    with pytest.raises(ValueError, match=message):
        surfels(**values)


def test_surfels_are_cropped_with_their_grid() -> None:
    """Those inside keep their place in space: voxel (2, 1, 3) is (1, 1, 2) of what begins at (1, 0, 1)."""
    places = np.ravel_multi_index(np.array([[0, 2], [1, 1], [2, 3]]), SHAPE)
    whole = surfels(voxel=np.asarray(places).tolist())

    part = whole.cropped(SHAPE, np.array([1, 0, 1]), np.array([4, 3, 4]))

    np.testing.assert_array_equal(np.unravel_index(part.voxel, (3, 3, 3)), [[1], [1], [2]])


@pytest.fixture
def prior(seed: int) -> ShapePrior:
    """A shape in which every mask has voxels and some were never seen."""
    generator = np.random.default_rng(seed)
    state = np.arange(60).reshape(SHAPE) % 4
    phi = np.choose(state, [0.05, 0.9, 0.8, 0.5]) + generator.uniform(-0.04, 0.04, SHAPE)
    pose = np.eye(4)
    pose[:3, 3] = [0.1, -0.2, 0.9]
    return ShapePrior(
        phi=phi.astype(np.float32),
        pitch_m=0.005,
        reference_from_grid=pose,
        seen_free=state == 0,
        seen_occupied=state == 1,
        enclosed=state == 2,
        rgb=generator.integers(0, 256, (*SHAPE, 3), dtype=np.uint8),
        surfels=Surfels(
            voxel=np.array([2, 7, 7], np.int32),
            offset_m=np.array([0.001, 0.002, -0.001], np.float32),
            sigma_m=np.array([0.0003, 0.0004, 0.002], np.float32),
            normal=np.array([[1, 0, 0], [0, 0.6, 0.8], [0, -0.6, -0.8]], np.float32),
        ),
    )


def test_saving_and_loading_gives_the_same_shape(prior: ShapePrior, tmp_path: Path) -> None:
    """Every field comes back, with and without colour, and equal shapes give equal bytes."""
    for shape in (prior, replace(prior, rgb=None)):
        shape.save(tmp_path / "a.npz")
        shape.save(tmp_path / "b.npz")

        loaded = ShapePrior.load(tmp_path / "a.npz")

        assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
        assert loaded.pitch_m == shape.pitch_m
        for name in ("phi", "reference_from_grid", "seen_free", "seen_occupied", "enclosed", "rgb"):
            np.testing.assert_array_equal(getattr(loaded, name), getattr(shape, name))
        for name, values in shape.surfels.arrays.items():
            np.testing.assert_array_equal(loaded.surfels.arrays[name], values)


def test_a_path_may_be_a_text(prior: ShapePrior, tmp_path: Path) -> None:
    """As docs/python.md writes it; the folder is made."""
    prior.save(str(tmp_path / "shapes" / "mug.npz"))

    np.testing.assert_array_equal(ShapePrior.load(str(tmp_path / "shapes" / "mug.npz")).phi, prior.phi)


def test_files_from_before_surfels_are_read(prior: ShapePrior, tmp_path: Path) -> None:
    """Format 1 is format 2 without them; a version that nobody has written yet is refused in one line."""
    bare = replace(prior, surfels=Surfels.none())
    bare.save(tmp_path / "new.npz")
    arrays = {name: values for name, values in np.load(tmp_path / "new.npz").items() if "surfel" not in name}
    np.savez(tmp_path / "old.npz", **{**arrays, "format_version": np.int64(1)})

    old = ShapePrior.load(tmp_path / "old.npz")

    assert len(old.surfels) == 0
    np.testing.assert_array_equal(old.surface().vertices_m, bare.surface().vertices_m)
    np.savez(tmp_path / "newer.npz", **{**arrays, "format_version": np.int64(3)})
    with pytest.raises(ValueError, match=r"newer\.npz has format_version 3, this program reads 1 and 2"):
        ShapePrior.load(tmp_path / "newer.npz")


def test_the_file_holds_the_names_of_the_contract(prior: ShapePrior, tmp_path: Path) -> None:
    """Other programs read these names with numpy alone."""
    prior.save(tmp_path / "shape.npz")

    with np.load(tmp_path / "shape.npz", allow_pickle=False) as arrays:
        assert set(arrays) == {
            *("phi", "pitch_m", "reference_from_grid"),
            *("seen_free", "seen_occupied", "enclosed", "rgb", "format_version"),
            *("surfel_voxel", "surfel_offset_m", "surfel_sigma_m", "surfel_normal"),
        }
        assert arrays["phi"].dtype == np.float32


def test_samples_follow_phi(key: jax.Array, prior: ShapePrior) -> None:
    """Each voxel of R draws is occupied with its own probability."""
    samples = prior.sample(key, 20_000)

    assert samples.shape == (20_000, *SHAPE)
    assert samples.dtype == np.bool_
    assert_mean(samples, prior.phi, detectable=0.03)


def test_bounding_box_holds_the_solid_voxels(prior: ShapePrior) -> None:
    """Faces of the box are faces of the outermost solid voxels."""
    enclosed = np.zeros(SHAPE, bool)
    occupied = np.zeros(SHAPE, bool)
    enclosed[2, 1, 3], occupied[1, 1, 2] = True, True
    shape = replace(prior, seen_free=~(enclosed | occupied), seen_occupied=occupied, enclosed=enclosed)

    np.testing.assert_allclose(shape.bounding_box_m, np.array([[1, 1, 2], [3, 2, 4]]) * 0.005)


def test_surface_fills_enclosed_voxels(prior: ShapePrior) -> None:
    """An enclosed voxel lies inside at every level, whatever its probability."""
    phi = np.where(prior.enclosed, np.float32(0.3), np.float32(0.0))
    shape = replace(prior, phi=phi, seen_free=~prior.enclosed, seen_occupied=np.zeros(SHAPE, bool))

    assert len(shape.surface(0.9).triangles) > 0


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("phi", np.full(SHAPE, 1.5, np.float32), "outside"),
        ("phi", np.full(SHAPE, np.nan, np.float32), "outside"),
        ("phi", np.zeros((2, 2), np.float32), "expected"),
        ("pitch_m", 0.0, "expected 0.0001 to 1 metres"),
        ("reference_from_grid", 2 * np.eye(4), "rigid"),
        ("enclosed", np.ones(SHAPE, bool), "two of"),
        ("enclosed", np.zeros(SHAPE, np.uint8), "bool"),
        ("rgb", np.zeros(SHAPE, np.uint8), "rgb"),
        ("surfels", surfels(voxel=[60]), "not in the grid"),
    ],
)
def test_values_that_are_no_shape_are_refused(
    prior: ShapePrior, field: str, value: object, message: str
) -> None:
    """A shape cannot be made from parts that contradict each other."""
    with pytest.raises(ValueError, match=message):
        replace(prior, **{field: value})


def test_damaged_files_are_refused_by_name(prior: ShapePrior, tmp_path: Path, seed: int) -> None:
    """Cut, flipped, foreign or missing arrays: one error that names the file, and nothing else."""
    good = tmp_path / "good.npz"
    bad = tmp_path / "bad.npz"
    prior.save(good)
    data = good.read_bytes()
    generator = np.random.default_rng(seed)
    for cut in generator.integers(0, len(data), 40):
        bad.write_bytes(data[:cut])
        with pytest.raises(ValueError, match=r"bad\.npz"):
            ShapePrior.load(bad)
    for position in generator.integers(0, len(data), 200):
        flipped = bytearray(data)
        flipped[position] ^= 1 << generator.integers(8)
        bad.write_bytes(flipped)
        try:
            loaded = ShapePrior.load(bad)
        except ValueError as error:
            assert "bad.npz" in str(error)  # noqa: PT017
        else:  # the bit stood where the zip format keeps nothing that is read
            np.testing.assert_array_equal(loaded.phi, prior.phi)
    np.savez(bad, phi=prior.phi, format_version=np.int64(1))
    with pytest.raises(ValueError, match=r"bad\.npz .* no array"):
        ShapePrior.load(bad)
    np.savez(bad, phi=prior.phi)
    with pytest.raises(ValueError, match="format_version none"):
        ShapePrior.load(bad)
    with pytest.raises(FileNotFoundError):
        ShapePrior.load(tmp_path / "absent.npz")


def test_claimed_sizes_are_checked_before_memory_is_taken(tmp_path: Path) -> None:
    """A header that claims a terabyte over a few stored bytes is refused."""
    path = tmp_path / "bomb.npz"
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (65536, 65536, 64), }"
    header += b" " * (64 - (len(header) + 11) % 64) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("phi.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)

    with pytest.raises(ValueError, match=r"bomb\.npz .* claims"):
        ShapePrior.load(path)


def test_a_save_that_fails_leaves_nothing_behind(prior: ShapePrior, tmp_path: Path) -> None:
    """No partial file stays where the folder cannot take the result."""
    (tmp_path / "shape.npz").mkdir()

    with pytest.raises(OSError, match=r"shape\.npz"):
        prior.save(tmp_path / "shape.npz")

    assert [path.name for path in tmp_path.iterdir()] == ["shape.npz"]


def test_what_is_known_of_a_surface() -> None:
    """A slab that was seen from above, on ground that nobody saw below it: its top, its sides, its bottom."""
    phi = np.full((5, 5, 3), 0.1, np.float32)
    phi[1:4, 1:4, :2] = 0.95
    solid = phi > 0.5
    occupied = solid.copy()
    occupied[..., 0] = False  # behind what was seen
    free = ~solid
    free[..., 0] = False  # beside the lower layer: never seen
    shape = ShapePrior(
        phi=phi,
        pitch_m=0.01,
        reference_from_grid=np.eye(4),
        seen_free=free,
        seen_occupied=occupied,
        enclosed=solid & ~occupied,
    )
    surface = shape.surface()
    states = shape.surface_states(surface)
    height_m = surface.vertices_m[:, 2]

    assert (states[height_m > 0.016] == SurfaceState.SEEN).all()
    assert (states[height_m < 0.005] == SurfaceState.NEVER_SEEN).all()
    shares = shape.surface_shares(surface)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert 0.3 < shares[SurfaceState.SEEN] < 0.8
    assert set(np.unique(shape.voxel_states)) == set(VoxelState)

    part = shape.seen_part(surface)
    assert 0 < len(part.triangles) < len(surface.triangles)
    centres = part.vertices_m[part.triangles].mean(axis=1)
    seen_m = (np.argwhere(shape.seen_occupied) + 0.5) * shape.pitch_m
    assert np.linalg.norm(centres[:, None] - seen_m[None], axis=2).min(axis=1).max() <= shape.pitch_m
