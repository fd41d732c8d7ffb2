"""The report is one page that needs nothing else, and says what calls for care."""

import io
import json
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from pipeline.cli import voxscene
from pipeline.publishing.publish import publish
from pipeline.publishing.summary import summary_of
from pipeline.publishing.values import RunValues
from pipeline.report import charts
from pipeline.report.page import Page
from pipeline.report.run_report import report
from pipeline.report.warnings import warnings_of
from pipeline.room import view_room
from pipeline.run_access import open_run_folder
from recordings.types import Damage
from slam.result import SlamResult


class Reader(HTMLParser):
    """Collects what a browser would load, the texts, and whether every tag is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.texts: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        """Every address, and the tags that need an end."""
        self.loaded += [value for key, value in attrs if key in {"src", "href", "data", "action"} and value]
        if tag not in {"img", "meta", "br", "link"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        """It ends the last one."""
        assert self.open.pop() == tag

    def handle_data(self, data):
        """Text of the page."""
        self.texts.append(data)


def read(page: str) -> Reader:
    """A page as a browser sees it."""
    reader = Reader()
    reader.feed(page)
    assert not reader.open
    return reader


@pytest.fixture
def run(parsed_run: RunValues, filmed_mug, tmp_path: Path) -> Path:
    """A finished run of slam and parse."""
    assert parsed_run.slam is not None
    room = view_room(filmed_mug, filmed_mug.intrinsics, parsed_run.slam.mean)
    values = {
        "slam": parsed_run.slam,
        "room": room,
        "objects": parsed_run.surfaces,
        "parse": parsed_run.scene,
    }
    with open_run_folder(tmp_path / "kitchen", {"rec": "hash"}) as folder:
        for name, value in values.items():
            folder.stage(name, type(value).load, lambda value=value: value, settings={}, inputs={})
    return tmp_path / "kitchen"


def test_a_page_escapes_what_it_is_told_and_loads_nothing() -> None:
    """Texts stay texts; pictures are inside the page."""
    page = Page("<b>")
    page.chapter("a & b")
    page.table(["", "<i>"], [["x", "1 < 2"]])
    page.pictures({'"caption"': charts.lines(np.arange(2.0), {"a": np.arange(2.0)}, "frame", "share")})
    reader = read(page.html())
    assert {"<b>", "a & b", "<i>", "1 < 2", '"caption"'} <= set(reader.texts)
    assert [address.split(",")[0] for address in reader.loaded] == ["data:image/png;base64"]


def test_the_report_stands_side_by_side_and_alone(run: Path, tmp_path: Path) -> None:
    """Two runs give two columns; every address is inside the page; the file opens without a network."""
    out, other = tmp_path / "r.html", tmp_path / "later"
    shutil.copytree(run, other)
    result = CliRunner().invoke(voxscene, ["report", str(run), str(other), "-o", str(out), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["report"] == str(out)
    reader = read(out.read_text())
    assert all(address.startswith(("#", "data:image/png;base64,")) for address in reader.loaded)
    assert "http" not in out.read_text().replace("http-equiv", "")
    for text in ("frames", "path length", "objects found", "2 of 3", "mug", "Objects", "Camera"):
        assert any(text in found for found in reader.texts), text


def test_the_report_tells_what_summary_json_tells(
    parsed_run: RunValues, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """The path's length without the guesses of lost frames; objects without a finite spread are left out."""
    mean, scene = true_trajectory.mean.copy(), parsed_run.scene
    mean[3, :3, 3] += 50.0
    assert scene is not None
    covariance = scene.covariance.copy()
    covariance[0] = np.nan
    values = {
        "slam": replace(true_trajectory, mean=mean, lost=np.arange(len(mean)) == 3),
        "objects": parsed_run.surfaces,
        "parse": replace(scene, covariance=covariance),
    }
    with open_run_folder(tmp_path / "run", {"rec": "hash"}) as folder:
        for name, value in values.items():
            folder.stage(name, type(value).load, lambda value=value: value, settings={}, inputs={})
        publish(folder)
    told = json.loads((tmp_path / "run" / "summary.json").read_text())
    texts = read(report([tmp_path / "run"]).html()).texts

    assert told["slam"]["length_m"] < 1
    assert f"{told['slam']['length_m']:.2f} m" in texts
    assert f"{len(told['parse']['objects'])} of 3" in texts


def test_runs_of_one_name_are_told_apart_and_none_is_lost(run: Path, tmp_path: Path) -> None:
    """By as many folders above as it takes; one that is named twice is told once."""
    for folder in ("p1.run/recordings", "p2.run/recordings", "p2.run/other"):
        shutil.copytree(run, tmp_path / folder / "kitchen")
        (tmp_path / folder).parent.joinpath("stages").mkdir(exist_ok=True)
    paths = ["p1.run", "p2.run", "p2.run/other/kitchen", "p2.run/recordings/kitchen", "kitchen"]
    reader = read(report([tmp_path / path for path in paths]).html())

    names = [f"{folder}/kitchen" for folder in ("p1.run/recordings", "p2.run/recordings", "other")]
    for name in (*names, f"{tmp_path.name}/kitchen"):
        assert reader.texts.count(name) == 3, name  # in the contents, the summary, and above its chapter


def test_what_is_no_run_is_told(tmp_path: Path) -> None:
    """In one line, exit code 1, and nothing is written."""
    result = CliRunner().invoke(voxscene, ["report", str(tmp_path), "-o", str(tmp_path / "r.html")])
    assert result.exit_code == 1
    assert "is no run" in result.stderr
    assert not (tmp_path / "r.html").exists()


def test_a_report_is_a_page_and_nothing_else(run: Path, tmp_path: Path) -> None:
    """A name that ends as another kind of file is refused before any work."""
    result = CliRunner().invoke(voxscene, ["report", str(run), "-o", str(tmp_path / "r.pdf")])
    assert result.exit_code == 2
    assert "HTML" in result.stderr
    assert not (tmp_path / "r.pdf").exists()


def test_a_report_takes_the_place_of_a_report_alone(run: Path, tmp_path: Path) -> None:
    """Or of an empty file; another page stays as it is, told in one line."""
    command = ["report", str(run), "-o", str(tmp_path / "r.html")]
    (tmp_path / "r.html").touch()
    for _ in range(2):
        assert CliRunner().invoke(voxscene, command).exit_code == 0
    (tmp_path / "r.html").write_text("<!doctype html>\n<title>thesis</title>\n")
    told = CliRunner().invoke(voxscene, command)
    assert (told.exit_code, told.stderr.count("\n")) == (1, 1)
    assert "r.html: it is there and is no report of voxscene, name another file" in told.stderr
    assert "thesis" in (tmp_path / "r.html").read_text()


def test_warnings_name_what_is_wrong_and_nothing_else(parsed_run: RunValues) -> None:
    """A sound run has none; each fault adds its own."""
    assert parsed_run.slam is not None
    slam = replace(
        parsed_run.slam, log_weights=np.log(np.full(3, 1 / 3)), hypotheses=np.ones(len(parsed_run.slam))
    )
    sound = replace(parsed_run, slam=slam, scene=None, surfaces=None)
    assert warnings_of(sound, summary_of(sound), Damage()) == []

    lost = slam.lost.copy()
    lost[2] = True
    faulty = replace(sound, slam=replace(slam, lost=lost))
    told = " ".join(warnings_of(faulty, summary_of(faulty), Damage(lost_messages=3)))
    for part in ("1 of 6 frames are lost, the first is frame 2", "3 messages"):
        assert part in told


def test_charts_are_pictures_whatever_the_values() -> None:
    """NaN, a single point and a flat path are drawn, not refused."""
    time = np.arange(3.0)
    values = {"a": np.array([1.0, np.nan, 2.0]), "b": np.zeros(3)}
    flat = np.stack([time, 0 * time, 0 * time], axis=-1)
    for picture in (
        charts.lines(time, values, "s", "cm", marked=time[:1]),
        charts.paths({"reference": flat, "ours": flat[:1]}),
        charts.cloud(flat, None, None),
    ):
        assert Image.open(io.BytesIO(picture)).width > 300


def test_the_widest_plane_is_the_one_a_path_lies_in() -> None:
    """A circle tilted in space is seen face on."""
    angle = np.linspace(0, 6, 50)
    across, up = np.array([1.0, 0, 0]), np.array([0, 0.6, 0.8])
    circle = np.outer(2 * np.cos(angle), across) + np.outer(np.sin(angle), up)
    np.testing.assert_allclose(np.abs(charts.widest_plane(circle) @ np.cross(across, up)), 0, atol=1e-9)
