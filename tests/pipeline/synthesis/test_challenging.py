"""Challenging images hold what their kind promises, told by a renderer and a geometry of the test's own."""

import numpy as np
import open3d as o3d
import pytest
import trimesh

from pipeline.errors import PipelineError
from pipeline.synthesis import challenging
from pipeline.synthesis.challenging import ChallengingImage, challenging_image, unplaceable
from pipeline.synthesis.challenging_kinds import KINDS
from pipeline.synthesis.challenging_scene import ChallengingScene
from pipeline.synthesis.challenging_views import BAND
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.scenarios import CameraConfig
from recordings.truth import TABLE, TrueObject
from recordings.types import CameraIntrinsics
from tests.pipeline.synthesis.z_buffer import z_buffer

SHAPES = {name: built_in_object(name) for name in ("box", "can", "bracket")}
SCENE = ChallengingScene(camera=CameraConfig(width=200, height=150))
BORDER_ERROR = 0.06
"""Of a visible fraction: silhouettes some 20 pixels wide, whose border two renderers may see otherwise."""


@pytest.fixture(scope="module", params=list(KINDS))
def image(request: pytest.FixtureRequest) -> ChallengingImage:
    """One image of each kind."""
    return challenging_image(SHAPES, request.param, "can", SCENE, (5, 0))


def pose_in_camera(image: ChallengingImage, one: TrueObject) -> np.ndarray:
    """camera_from_object."""
    return np.linalg.inv(image.recording.trajectory.reference_from_camera[0]) @ one.world_from_object


def tensor(values: np.ndarray, dtype: type) -> o3d.core.Tensor:
    """Open3D's array."""
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype))


def widened(intrinsics: CameraIntrinsics) -> tuple[CameraIntrinsics, tuple[slice, slice]]:
    """A camera that sees three times as far to every side, and where the original image lies in its own."""
    width, height = intrinsics.width, intrinsics.height
    wide = CameraIntrinsics(
        width=3 * width,
        height=3 * height,
        fx=intrinsics.fx,
        fy=intrinsics.fy,
        cx=intrinsics.cx + width,
        cy=intrinsics.cy + height,
    )
    return wide, (slice(height, 2 * height), slice(width, 2 * width))


def test_each_kind_shows_what_it_promises(image: ChallengingImage) -> None:
    """The visible fraction by another renderer, within the kind's limits; its cause is the kind's own."""
    objects = image.recording.truth.objects
    posed = [(SHAPES[one.shape], pose_in_camera(image, one)) for one in objects]
    wide, original = widened(image.recording.intrinsics)
    target = [one.name for one in objects].index(image.target)
    alone = z_buffer([posed[target]], wide)[1] == 0
    together = z_buffer(posed, wide)[1] == target
    inside, shown = alone[original].sum() / alone.sum(), together[original].sum() / alone.sum()
    low, high = KINDS[image.kind]

    assert low - BORDER_ERROR <= shown <= high + BORDER_ERROR
    assert objects[target].visible_fraction == pytest.approx(shown, abs=BORDER_ERROR)
    assert low <= (objects[target].visible_fraction or 0) <= high
    assert (inside < 1 - BAND) == (image.kind == "partial")
    assert (together.sum() < (1 - BORDER_ERROR) * alone.sum()) <= (image.kind in {"occluded", "stacked"})
    assert any(one.parent != TABLE for one in objects) == (image.kind == "stacked")
    assert len(objects) >= {"single": 1, "partial": 1, "occluded": 2, "stacked": 2}[image.kind]


def test_the_camera_keeps_to_its_distances_and_elevations(image: ChallengingImage) -> None:
    """0.6 to 1.1 m from the target's middle, 15 to 65 degrees above it."""
    (target,) = (one for one in image.recording.truth.objects if one.name == image.target)
    corners = trimesh.transform_points(SHAPES[target.shape].vertices, target.world_from_object)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    to_camera = image.recording.trajectory.reference_from_camera[0, :3, 3] - middle
    distance = np.linalg.norm(to_camera)

    assert 0.6 - 1e-9 <= distance <= 1.1 + 1e-9
    assert 15 - 1e-6 <= np.degrees(np.arcsin(to_camera[2] / distance)) <= 65 + 1e-6


def test_objects_do_not_reach_into_each_other(image: ChallengingImage) -> None:
    """No vertex of one lies deeper than 1 mm in another or in the table."""
    objects = image.recording.truth.objects
    for one in objects:
        points = trimesh.transform_points(SHAPES[one.shape].vertices, one.world_from_object)
        assert points[:, 2].min() > SCENE.table_height_m - 1e-3
        for other in objects:
            if other is not one:
                local = trimesh.transform_points(points, np.linalg.inv(other.world_from_object))
                surface = o3d.t.geometry.RaycastingScene()
                surface.add_triangles(
                    tensor(SHAPES[other.shape].vertices, np.float32),
                    tensor(SHAPES[other.shape].faces, np.uint32),
                )
                assert surface.compute_signed_distance(tensor(local, np.float32)).numpy().min() > -1e-3


def test_numbers_make_the_image(image: ChallengingImage) -> None:
    """The same bytes again; other numbers give another image."""
    again = challenging_image(SHAPES, image.kind, "can", SCENE, (5, 0)).recording.frame(0)
    other = challenging_image(SHAPES, image.kind, "can", SCENE, (5, 1)).recording.frame(0)
    frame = image.recording.frame(0)

    np.testing.assert_array_equal(frame.depth_m, again.depth_m)
    np.testing.assert_array_equal(frame.rgb, again.rgb)
    assert not np.array_equal(frame.depth_m, other.depth_m)


def test_visible_fractions_fill_their_range() -> None:
    """Cut by the border: 24 fractions fall into every third of 0.2 to 0.7.

    Uniform ones miss a third with probability 3 (2/3)^24 = 0.0002.
    """
    shares = []
    for number in range(24):
        image = challenging_image(SHAPES, "partial", "box", SCENE, (6, number))
        shares.append(image.recording.truth.objects[0].visible_fraction)
    assert np.histogram(shares, np.linspace(0.2, 0.7, 4))[0].min() > 0


def test_what_cannot_be_reached_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the number of tries; limits outside the kind's own are refused before any."""
    monkeypatch.setattr(challenging, "ARRANGEMENTS", 2)
    scene = ChallengingScene(camera=SCENE.camera, visible=(0.955, 0.96))
    with pytest.raises(PipelineError, match=r"shows 0\.955 to 0\.96 of can: 20 cameras tried"):
        challenging_image(SHAPES, "single", "can", scene, (1,))
    with pytest.raises(PipelineError, match="leaves nothing of occluded images"):
        scene.limits("occluded")


def test_shapes_that_find_no_place_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plate wider than the table rests nowhere; the others do."""
    monkeypatch.setattr(challenging, "ARRANGEMENTS", 2)
    shapes = {**SHAPES, "board": trimesh.creation.box((1.4, 1.4, 0.02))}
    assert unplaceable(shapes, "single", SCENE) == {"board": "does not come to rest"}
    assert unplaceable({"can": SHAPES["can"]}, "stacked", SCENE) == {"can": "cannot be stacked"}
