"""The bench of poses: who is judged on what, rows that outlive an interruption, and peers alone."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from pipeline.benchmarks.pose_figures import pose_figures
from pipeline.benchmarks.pose_images import PoseImage
from pipeline.benchmarks.pose_methods import Estimated, Parse
from pipeline.benchmarks.pose_presence import presences
from pipeline.benchmarks.pose_report import report_lines
from pipeline.benchmarks.pose_rows import Judged, write_csv
from pipeline.benchmarks.pose_sources import Tables
from pipeline.benchmarks.poses import judged_images, judgements
from pipeline.benchmarks.presence_figures import Reported, presence_figures
from pipeline.errors import PipelineError
from pipeline.evaluation.object_poses import MISSING_M, add_s_m, model_points
from pipeline.executors import executors_for
from pipeline.figures.accuracy_curves import accuracy_curve, draw_curves
from pipeline.figures.pose_sheets import picked_by_difference, picked_worst
from pipeline.mesh_source import MeshSource
from pipeline.peers.registration import Model, settings
from pipeline.synthesis.objects import built_in_object
from tests.scene.results import scene_result

SHAPES = MeshSource(names=("bracket", "mug", "bottle"))
TABLES = Tables(shapes=SHAPES, objects=3, seed=1, numbers=(0, 1))
SHIFT_M = np.array([0.004, -0.003, 0.012])


@dataclass(frozen=True, kw_only=True)
class Truthful:
    """A method that knows the truth, moved by a shift, without the shapes that it misses."""

    title: str = "truthful"
    setting: str = ""
    shift_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    misses: tuple[str, ...] = ()
    tried: list[str] = field(default_factory=list, compare=False, repr=False)

    def estimate(self, image: PoseImage, shapes: MeshSource) -> Estimated:
        """The true poses."""
        assert shapes is not None
        self.tried.append(str(image.key))
        shift = np.eye(4)
        shift[:3, 3] = self.shift_m
        return Estimated(
            poses=[
                (one.shape, shift @ image.camera_from_world @ one.world_from_object)
                for one in image.objects
                if one.shape not in self.misses
            ],
            seconds=0.5,
        )


@pytest.fixture(scope="module")
def image() -> PoseImage:
    """Three objects, one of them stacked."""
    return TABLES.image(TABLES.places()[0])


def test_tables_repeat_and_differ(image: PoseImage) -> None:
    """The same number gives the same depth, and a third of the objects are stacked."""
    again, other = (TABLES.image(TABLES.places()[number]) for number in (0, 1))
    np.testing.assert_array_equal(image.frame.depth_m, again.frame.depth_m)
    assert (image.frame.depth_m != other.frame.depth_m).any()
    assert sum(one.parent != "table" for one in image.objects) >= 1


def test_errors_are_those_of_brute_force(image: PoseImage) -> None:
    """The truth has none, a shift has that of a search over all pairs, what is missing counts a metre."""
    exact = judgements(image, Truthful(), Truthful().estimate(image, SHAPES))
    assert [one.error_m for one in exact] == pytest.approx([0] * 3, abs=1e-9)
    moved = Truthful(shift_m=tuple(SHIFT_M), misses=("mug",))
    for one in judgements(image, moved, moved.estimate(image, SHAPES)):
        if one.shape == "mug":
            assert (one.error_m, one.estimate) == (MISSING_M, None)
            continue
        points = model_points(SHAPES.meshes[one.shape])[:400]
        (true,) = (other for other in image.objects if other.name == one.name)
        pose = image.camera_from_world @ true.world_from_object
        placed = points @ pose[:3, :3].T + pose[:3, 3]
        brute = np.linalg.norm(placed[:, None] - (placed + SHIFT_M)[None], axis=-1).min(axis=1).mean()
        estimate = one.camera_from_object
        assert estimate is not None
        assert add_s_m(points, pose, estimate) == pytest.approx(brute, abs=1e-9)
        everything = KDTree(model_points(SHAPES.meshes[one.shape]) @ pose[:3, :3].T + pose[:3, 3] + SHIFT_M)
        whole = model_points(SHAPES.meshes[one.shape]) @ pose[:3, :3].T + pose[:3, 3]
        assert one.error_m == pytest.approx(everything.query(whole)[0].mean(), abs=1e-9)


def test_true_masks_hold_the_object_alone(image: PoseImage) -> None:
    """Masked points lie on the object; unmasked ones hold them all."""
    for index, one in enumerate(image.objects):
        points = image.points(index, masked=True)
        inside = np.linalg.inv(image.camera_from_world @ one.world_from_object)
        own = points @ inside[:3, :3].T + inside[:3, 3]
        low, high = SHAPES.meshes[one.shape].bounds
        assert len(points) > 0
        assert ((own > low - 0.013) & (own < high + 0.013)).all()
        assert len(points) <= len(image.points(index, masked=False))


def test_rows_are_kept_between_runs(tmp_path: Path) -> None:
    """What is in the folder is not tried again; a new method is, and only it; another table has its own."""
    executors, at_once = executors_for(1)

    def run(*methods: Truthful) -> list[Judged]:
        found = judged_images(TABLES, methods, executors, at_once, tmp_path)
        return [row for _, image in found for _, rows, _ in image for row in rows]

    first, second = Truthful(), Truthful(title="shifted", shift_m=tuple(SHIFT_M))
    rows = run(first)
    assert (len(rows), len(first.tried)) == (6, 2)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.json")}
    assert sorted(run(first), key=repr) == sorted(rows, key=repr)
    assert len(first.tried) == 2
    assert len(run(first, second)) == 12
    assert (len(first.tried), len(second.tried)) == (2, 2)
    assert all(path.read_bytes() == content for path, content in before.items())
    some = next(iter(before))
    some.write_text("{")
    assert sorted(run(first), key=repr) == sorted(rows, key=repr)
    assert len(first.tried) == 3
    assert some.read_bytes() == before[some]


@pytest.mark.parametrize("peer", ["fpfh", "icp24", "ppf"])
def test_a_peer_finds_a_whole_object(peer: str) -> None:
    """Its own points, turned: within 5 mm with its best setting."""
    if peer == "ppf":
        pytest.importorskip("cv2")
    mesh = built_in_object("bracket")
    model = Model.of(mesh)
    pose = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.0], [0, 0, 1, 0.8], [0, 0, 0, 1.0]])
    observed = model.points_m @ pose[:3, :3].T + pose[:3, 3]
    points = model_points(mesh)
    errors = [add_s_m(points, pose, register(model, observed)) for register in settings()[peer].values()]
    assert min(errors) < 0.005


@pytest.fixture
def judged() -> list[Judged]:
    """One method on two tables."""
    right = Judged(
        method="ours",
        setting="",
        kind="table",
        scene_id=0,
        im_id=0,
        name="mug",
        shape="mug",
        error_m=0.002,
        visible_fraction=1.0,
        stacked=False,
        flush=True,
        parent_right=True,
        there=True,
        score=0.9,
        level=0.6,
        estimate=tuple(np.eye(4)[:3].ravel()),
    )
    wrong = replace(
        right, name="can", level=0.3, error_m=0.015, stacked=True, parent_right=False, visible_fraction=0.1
    )
    missing = replace(
        right,
        error_m=1.0,
        stacked=True,
        flush=False,
        parent_right=None,
        im_id=1,
        score=None,
        level=None,
        estimate=None,
    )
    return [right, wrong, missing]


def test_rows(judged: list[Judged], tmp_path: Path) -> None:
    """Stacked and not, bins of what is seen, parents by the kind of rest, seconds of images."""
    other = [replace(one, method="other", error_m=0.5) for one in judged]
    seconds = {"ours": {judged[0].image: 1.0, judged[2].image: 3.0}}
    document = pose_figures([*judged, *other], seconds)
    assert document["images"] == 2
    figures = document["methods"]["ours"]
    assert figures["rows"]["all"]["accuracy"]["0.01"] == pytest.approx(1 / 3)
    z2, share = 1.959964**2, 1 / 3  # Wilson (1927): roots of (p - share)^2 = z^2 p (1 - p) / 3
    ends = np.roots([1 + z2 / 3, -(2 * share + z2 / 3), share**2])
    np.testing.assert_allclose(figures["rows"]["all"]["right_interval"], np.sort(ends), atol=1e-5)
    assert figures["rows"]["stacked on tables"]["objects"] == 2
    assert figures["edges"]["flush"] == {"rests": 2, "right": 0.5}
    assert figures["edges"]["other"] == {"rests": 0, "right": None}
    assert (figures["seconds_median"], figures["seconds_most"]) == (2.0, 3.0)
    assert figures["coverage"] == {"objects": 2, "inside": {"50%": 0.5, "90%": 1.0, "95%": 1.0}}
    bins = {row["visible"]: row["objects"] for row in document["by_visible_fraction"]}
    assert bins == {"5% to 15%": 1, "75% to 100%": 2}
    whole = document["differences"][0]
    assert (whole["group"], whole["second"], whole["objects"]) == ("all", "other", 3)
    assert whole["share"] == pytest.approx(1 / 3)
    assert whole["low"] < whole["share"] < whole["high"]
    assert any("5% to 15%" in line for line in report_lines(document))
    write_csv(tmp_path / "rows.csv", judged)
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 4


def test_curves_are_strict_and_drawn(judged: list[Judged], tmp_path: Path) -> None:
    """A staircase that rises behind each error; all right reaches one; no clock in the files."""
    thresholds, shares = accuracy_curve([0.01, 0.002, 1.0, 0.01])
    np.testing.assert_allclose(thresholds, [0, 0.002, 0.01, 0.01, 0.03])
    np.testing.assert_allclose(shares, [0, 0.25, 0.5, 0.75, 0.75])
    assert accuracy_curve([0.0, 1e-6])[1].tolist() == [0, 0.5, 1, 1]
    for suffix in ("png", "svg"):
        paths = [tmp_path / f"{name}.{suffix}" for name in ("first", "second")]
        for path in paths:
            draw_curves(judged, path)
        assert paths[0].read_bytes() == paths[1].read_bytes()


def test_images_for_sheets_are_picked_by_rule(judged: list[Judged]) -> None:
    """Two of largest gain and two of least, errors over 10 cm counting as that; the worst first."""
    errors = {0: (0.001, 0.05), 1: (0.002, 0.002), 2: (0.3, 0.001), 3: (0.001, 1.0), 4: (0.001, 0.002)}
    rows = [
        replace(judged[0], im_id=number, method=method, error_m=error)
        for number, pair in errors.items()
        for method, error in zip(("ours", "other"), pair, strict=True)
    ]
    assert [one.im_id for one in picked_by_difference(rows, "mug", "ours", "other")] == [3, 0, 1, 2]
    assert [one.im_id for one in picked_worst(rows, "ours")][:2] == [2, 1]


def test_presence_is_counted_against_what_is_there() -> None:
    """Absent or misplaced but found is false; there but not found is missed; each bin has its own share."""

    def said(presence: float, there: bool, error_m: float = np.inf) -> Reported:
        return Reported(shape="mug", presence=presence, there=there, error_m=error_m)

    figures = presence_figures(
        [
            said(1.0, True, 0.001),
            said(0.99, False),
            said(0.7, True, 0.1),
            said(0.4, True, 1.0),
            said(0.01, False),
        ]
    )
    assert (figures["asked"], figures["absent"]) == (5, 2)
    assert (figures["false"], figures["missed"]) == (2, 1)
    assert [one["count"] for one in figures["calibration"]] == [1, 1, 1, 2]
    assert [one["right"] for one in figures["calibration"]] == [0.0, 1.0, 0.0, 0.5]
    assert figures["calibration"][-1]["presence"] == pytest.approx(0.995)


def test_absent_shapes_are_asked_for_in_place_of_present_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of two on the table, and the one that is not; what is found without being there has no error."""
    tables = Tables(shapes=SHAPES, objects=2, seed=5, numbers=(0,))
    present = set(tables.image(tables.places()[0]).shapes)
    asked: list[str] = []

    def parsed(method: Parse, image: PoseImage, shapes: MeshSource, names: list[str]) -> tuple[object, None]:
        assert method.config.presence == 0.5
        assert shapes is SHAPES
        asked[:] = names
        true = {one.shape: image.camera_from_world @ one.world_from_object for one in image.objects}
        return scene_result(names, [true.get(name, np.eye(4)) for name in names], [2, 2]), None

    monkeypatch.setattr(Parse, "parsed", parsed)
    reported = {one.shape: one for one in presences(tables, 0, 1, 0)}
    assert len(present & set(asked)) == 1
    assert len(set(asked) - present) == 1
    for name, one in reported.items():
        assert one.there == (name in present)
        assert one.right == one.there


def test_an_image_that_fails_is_named() -> None:
    """The error says which image, and rows before it stay."""

    class Failing(Truthful):
        def estimate(self, image: PoseImage, shapes: MeshSource) -> Estimated:
            raise ValueError(f"nothing to be seen of {len(shapes.names)} shapes in {image.key.kind}")

    executors, at_once = executors_for(1)
    with pytest.raises(PipelineError, match="image table 0 0: nothing to be seen"):
        list(judged_images(TABLES, [Failing()], executors, at_once))
