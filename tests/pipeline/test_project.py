"""Project files are read, ordered and checked before any work begins."""

from pathlib import Path

import pytest

from pipeline.config import Settings
from pipeline.errors import ConfigError
from pipeline.project import Project, read_project
from slam.config import SlamConfig


def project(tmp_path: Path, text: str) -> Project:
    """A project file with this text."""
    path = tmp_path / "project.toml"
    path.write_text(text)
    return read_project(path)


def test_shapes_are_learned_before_they_are_looked_for(tmp_path: Path) -> None:
    """Paths count from the project file; names are the files' unless given."""
    found = project(
        tmp_path,
        """
        [slam]
        particles = 16
        [[recording]]
        path = "table.mcap"
        stage = "parse"
        objects = ["cup", "can"]
        every = 2
        [[recording]]
        path = "data/mug.mcap"
        stage = "learn"
        name = "cup"
        [[recording]]
        path = "can.mcap.zstd"
        stage = "learn"
        """,
    )

    assert [(one.path, one.stage, one.stem, one.shape) for one in found.recordings] == [
        (tmp_path / "data/mug.mcap", "learn", "mug", "cup"),
        (tmp_path / "can.mcap.zstd", "learn", "can", "can"),
        (tmp_path / "table.mcap", "parse", "table", "table"),
    ]
    assert found.recordings[2].objects == ("cup", "can")
    assert found.recordings[2].reading == {"every": 2}
    assert found.settings == {"slam": {"particles": 16}}


@pytest.mark.parametrize("above", ["", "{folder}/"])
def test_signs_match_files_of_dated_names(tmp_path: Path, above: str) -> None:
    """Relative to the project file or from the root; a name ends where .mcap begins."""
    for name in ("bag.2024.mcap", "bag.2025.mcap.zstd", "bag.txt"):
        (tmp_path / name).touch()

    path = above.format(folder=tmp_path) + "*.mcap*"
    found = project(tmp_path, f"[[recording]]\npath = '{path}'\nstage = 'slam'")

    assert [one.stem for one in found.recordings] == ["bag.2024", "bag.2025"]


def test_a_recording_may_have_settings_and_shapes_of_its_own(tmp_path: Path) -> None:
    """Beneath the command line's, over the project's."""
    found = project(
        tmp_path,
        """
        [[recording]]
        path = "table.mcap"
        stage = "parse"
        shapes = "meshes"
        parse.presence = 0.5
        """,
    ).recordings[0]

    assert found.shapes == tmp_path / "meshes"
    assert found.settings == {"parse": {"presence": 0.5}}


def test_the_command_lines_settings_stand_over_the_projects(tmp_path: Path) -> None:
    """Key by key."""
    found = project(
        tmp_path,
        "[slam]\nparticles = 16\nmotion = 'orbit'\n[[recording]]\npath = 'a.mcap'\nstage = 'slam'\n",
    )
    settings = Settings.read(None, ("slam.particles=32",)).over(found.settings)

    assert settings.section("slam", SlamConfig) == SlamConfig(particles=32, motion="orbit")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no [[recording]]"),
        ("[recording]\nevery = 2", "has no [[recording]]"),
        (
            "[[recording]]\npath = 'a'\nstage = 'see'",
            "recording 1.stage: input should be 'slam', 'learn' or 'parse'",
        ),
        ("[[recording]]\nstage = 'slam'", "recording 1.path: field required"),
        ("[[recording]]\npath = 'a'\nstage = 'slam'\nnmae = 'b'", "recording 1.nmae; did you mean 'name'?"),
        ("[[recording]]\npath = 'a'\nstage = 'learn'\nname = '../b'", "name must be up to 100 letters"),
        ("[[recording]]\npath = 'a'\nstage = 'slam'\nreading = {every = 2}", "no setting"),
        ("[[recording]]\npath = 'a'\nstage = 'slam'\nsettings = 3", "no setting"),
        ("[[recording]]\npath = 'a'\nstage = 'slam'\nparse.frames = [0]", "parse is for stage = 'parse'"),
        ("[[recording]]\npath = 'a'\nstage = 'learn'\nobjects = ['b']", "objects is for stage = 'parse'"),
        ("[[recording]]\npath = 'a'\nstage = 'slam'\nevrey = 2", "recording 1.evrey; did you mean 'every'?"),
        (
            "[[recording]]\npath = 'a'\nstage = 'slam'\n[[recording]]\npath = 'x/a'\nstage = 'slam'",
            "two recordings are named a; give one of the files another name",
        ),
        (
            "[[recording]]\npath = 'a'\nstage = 'learn'\nname = 'c'\n"
            "[[recording]]\npath = 'b'\nstage = 'learn'\nname = 'c'",
            "two shapes are named c",
        ),
        ("[[recording]]\npath = 'a'\nstage = 'parse'", "nothing is learned that"),
        ("[[recording]]\npath = 'a'\nstage = 'slam'\nslam = 3", "recording 1.settings.slam: input should be"),
        ("[slum]\n[[recording]]\npath = 'a'\nstage = 'slam'", "no section 'slum'"),
        ("[[recording", "is not TOML"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, message: str) -> None:
    """With the number of the recording."""
    with pytest.raises(ConfigError) as caught:
        project(tmp_path, text)

    assert message in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    """With its path."""
    with pytest.raises(ConfigError, match="cannot read settings"):
        read_project(tmp_path / "none.toml")
