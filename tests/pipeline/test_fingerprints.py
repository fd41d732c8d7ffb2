"""A hash of the sources that a stage can reach changes with each of them, and with no other."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline import fingerprints
from pipeline.fingerprints import source_hash


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


def test_every_stage_reaches_its_sources() -> None:
    """By the names that it gives: none of them is misspelt."""
    from pipeline.session import READING_MODULE
    from pipeline.stages import learn, parse, room, slam

    for stage in (slam, learn, parse, room):
        for module in (*stage.SOURCES, READING_MODULE):
            path = fingerprints.ROOT.joinpath(*module.split("."))
            assert path.with_suffix(".py").is_file(), module
