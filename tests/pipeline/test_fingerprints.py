"""A hash of the sources that a stage can reach changes with each of them, and with no other."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from pipeline import demo, fingerprints
from pipeline.config import Settings
from pipeline.fingerprints import recording_hash, source_hash
from pipeline.mesh_source import MeshSource
from pipeline.options import Common
from pipeline.publishing.publish import publish
from pipeline.run_folder import RunFolder
from pipeline.stages import parse
from pipeline.synthesis.challenging_scene import ChallengingScene
from pipeline.synthesis.challenging_set import ChallengingSet
from pipeline.synthesis.scenarios import ObjectScene


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Two packages, one of which imports from the other in every way there is."""
    for name, text in {
        "slam/tracking.py": "from slam import filter as f\nfrom slam.maps import (\n    one,\n    two,\n)\n",
        "slam/filter.py": "def late() -> None:\n    import shapes.deep\n",
        "slam/maps/__init__.py": "",
        "slam/maps/one.py": "",
        "slam/maps/two.py": "import numpy\n",
        "slam/unrelated.py": "",
        "shapes/deep.py": "from pipeline.clocks import now\n",
        "pipeline/clocks.py": "",
        "pipeline/stage.py": "from pipeline.clocks import now\n\nfrom slam.tracking import track\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(fingerprints, "ROOT", tmp_path)
    source_hash.cache_clear()
    yield tmp_path
    source_hash.cache_clear()


@pytest.mark.parametrize(
    ("changed", "is_reached"),
    [
        *(("slam/" + name, True) for name in ("tracking.py", "filter.py", "maps/one.py", "maps/two.py")),
        *((name, True) for name in ("shapes/deep.py", "pipeline/stage.py")),
        *((name, False) for name in ("slam/unrelated.py", "pipeline/clocks.py")),
    ],
)
def test_the_hash_follows_imports(sources: Path, changed: str, is_reached: bool) -> None:
    """Of modules in packages, within functions, over several lines; not into the pipeline."""
    before = source_hash("pipeline.stage")
    path = sources / changed
    path.write_text(path.read_text() + "# changed\n")
    source_hash.cache_clear()

    assert (source_hash("pipeline.stage") != before) == is_reached


def test_a_folder_is_known_by_the_files_of_its_recording(mug_file: Path, tmp_path: Path) -> None:
    """And by no run, profile or report that was made of it and stands there too."""
    bag = tmp_path / "bag"
    bag.mkdir()
    shutil.copy(mug_file, bag / "bag_0.mcap")
    before = recording_hash(bag)
    (bag / "mug.run" / "stages").mkdir(parents=True)
    (bag / "mug.run" / "run.mcap").write_bytes(b"views")
    (bag / "camera.toml").write_text("format_version = 4")
    assert recording_hash(bag) == before
    shutil.copy(mug_file, bag / "bag_1.mcap")
    parted = recording_hash(bag)
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    assert len({before, parted, recording_hash(bag), recording_hash(mug_file)}) == 4


def test_every_stage_reaches_its_sources() -> None:
    """By the names that it gives: none of them is misspelt."""
    from pipeline.session import READING_MODULE
    from pipeline.stages import learn, parse, room, slam

    for stage in (slam, learn, parse, room):
        for module in (*stage.SOURCES, READING_MODULE):
            path = fingerprints.ROOT.joinpath(*module.split("."))
            assert path.with_suffix(".py").is_file(), module


class Enough(Exception):  # noqa: N818  (nothing is wrong)
    """The hash was asked for; nothing needs to be made."""


def film(folder: Path) -> None:
    """A recording of the demo, up to its filming."""

    def film_of(*_: object) -> None:
        raise Enough

    common = Common(as_json=False, quiet=True, settings=Settings({}))
    demo._write(folder, "box", film_of, ObjectScene(), 0, common)  # type: ignore[arg-type]


def tell(folder: Path) -> None:
    """The derived files of a run, up to their writing."""
    publish(RunFolder(folder))


def number(_: Path) -> None:
    """A set of challenging images."""
    shapes = MeshSource(names=("box",))
    wanted = ChallengingSet(kinds=(), images=1, scene=ChallengingScene(), shapes=shapes, seed=0)
    assert wanted.fingerprint


@pytest.mark.parametrize(
    ("ask", "modules"),
    [
        (film, {"pipeline.meshes", "shapes.depth_noise", "recordings.writer"}),
        (number, {"pipeline.meshes", "shapes.depth_noise", "recordings.truth"}),
        (tell, {"pipeline.room", "pipeline.surfaces", "pipeline.colours", "pipeline.report.charts"}),
        (lambda _: source_hash(*parse.SOURCES), {"pipeline.simplification", "scene.parsing"}),
    ],
)
def test_what_is_kept_hangs_on_all_that_makes_it(
    ask: Callable[[Path], object], modules: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Modules of other packages too: a change of them makes it anew."""
    reached: list[str] = []
    source = fingerprints._source

    def look_up(module: str) -> Path | None:
        reached.append(module)
        return source(module)

    monkeypatch.setattr(fingerprints, "_source", look_up)
    (tmp_path / "stages").mkdir()
    source_hash.cache_clear()
    monkeypatch.setattr("pipeline.publishing.derived_files.write_derived_files", lambda _: [])
    with suppress(Enough):
        ask(tmp_path)

    assert modules <= set(reached)
