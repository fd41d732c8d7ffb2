"""`voxscene parse --colour only`: things on a table from one colour image, without depth."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result
from mcap.reader import make_reader
from mcap.writer import Writer

from pipeline.cli import voxscene
from pipeline.synthesis.air import AirScene, air_meshes, air_scene, air_world, write_air_scene
from pipeline.synthesis.air import photograph as photograph_of
from pipeline.synthesis.filming import film_table
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import TableScene
from recordings.writer import RecordingWriter
from scene.colour.density import sample
from scene.colour.posterior import Scene
from scene.config import ParseConfig

SEED = 7
"""Of a scene with a cube and a cylinder."""


@pytest.fixture(scope="module")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of one colour image, whose depth shows nothing."""
    path = tmp_path_factory.mktemp("air") / "air.mcap"
    world = air_world(48, 48)
    write_air_scene(world, air_scene(world, SEED), path)
    return path


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of what stands there, and of a ball."""
    folder = tmp_path_factory.mktemp("meshes")
    for name in ("ball", "cube", "cylinder"):
        air_meshes()[name].export(folder / f"{name}.ply")
    return folder


def parse(recording: Path, shapes: Path, run: Path, *more: str) -> Result:
    """The command, with few sweeps of its chains."""
    options = ["--colour", "only", "-s", "parse.sweeps=6", "-s", "parse.gamma=1", "--quiet", *more]
    return CliRunner().invoke(
        voxscene, ["parse", str(recording), "--shapes", str(shapes), "-o", str(run), *options]
    )


def without_depth(source: Path, target: Path) -> Path:
    """A copy with the colour images and their camera alone."""
    with source.open("rb") as reading, target.open("wb") as writing:
        writer = Writer(writing)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(reading).iter_messages(log_time_order=False):
            if "color" not in channel.topic or schema is None:
                continue
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


def test_things_are_found_without_depth(photograph: Path, meshes: Path, tmp_path: Path) -> None:
    """Both kinds within 5 mm, nothing else; the table is where the camera's recorded pose puts it."""
    result = parse(photograph, meshes, tmp_path / "run", "--light", "-0.4,-0.5,0.77,0.4")
    assert result.exit_code == 0, result.output
    evaluated = CliRunner().invoke(
        voxscene, ["eval", "poses", str(tmp_path / "run"), "--truth", str(photograph), "--json"]
    )
    document = json.loads(evaluated.stdout)
    assert document["not_there"] == []
    assert [one["found"] for one in document["objects"]] == [True, True]
    assert document["largest_m"] < 0.005
    parsed = json.loads((tmp_path / "run" / "summary.json").read_text())["parse"]
    assert {one["name"] for one in parsed["objects"]} == {"cube", "cylinder"}


def test_known_colours_name_what_is_there(tmp_path: Path) -> None:
    """Of two cubes that differ in colour alone the red one stands there, a fifth darker than its model."""
    world = air_world(48, 48)
    cube = air_meshes()["cube"]
    red, green = np.array([0.8, 0.2, 0.2]), np.array([0.2, 0.6, 0.3])
    (tmp_path / "meshes").mkdir()
    for name, rgb in (("red", red), ("green", green)):
        vertex_colors = np.tile(np.append(np.rint(255 * rgb), 255).astype(np.uint8), (len(cube.vertices), 1))
        painted = trimesh.Trimesh(cube.vertices, cube.faces, vertex_colors=vertex_colors, process=False)
        painted.export(tmp_path / "meshes" / f"{name}.ply")
    kind = [one.name for one in world.kinds].index("cube")
    truth = Scene(np.array([kind]), np.array([[0.03, -0.02, 0.4]]))
    albedo = 0.8 * red[None]
    clean, visible = photograph_of(world, truth, albedo)
    image = sample(np.random.default_rng(SEED), clean, world.noise)
    write_air_scene(
        world, AirScene(truth=truth, albedo=albedo, visible=visible, image=image), tmp_path / "air.mcap"
    )
    lamp = ("--light", "-0.4,-0.5,0.77,0.4")
    result = parse(tmp_path / "air.mcap", tmp_path / "meshes", tmp_path / "run", *lamp)
    assert result.exit_code == 0, result.output
    (found,) = json.loads((tmp_path / "run" / "summary.json").read_text())["parse"]["objects"]
    assert found["name"] == "red"
    assert found["presence"] > 0.99


def test_an_empty_table_is_an_answer(meshes: Path, tmp_path: Path) -> None:
    """Nothing stands there, and everything that was asked for is told as missing."""
    world, none = air_world(48, 48), np.zeros((0, 3))
    clean, visible = photograph_of(world, Scene.empty(), none)
    image = sample(np.random.default_rng(SEED), clean, world.noise)
    write_air_scene(
        world,
        AirScene(truth=Scene.empty(), albedo=none, visible=visible, image=image),
        tmp_path / "air.mcap",
    )
    result = parse(tmp_path / "air.mcap", meshes, tmp_path / "run", "--light", "-0.4,-0.5,0.77,0.4")
    assert result.exit_code == 0, result.output
    parsed = json.loads((tmp_path / "run" / "summary.json").read_text())["parse"]
    assert parsed["objects"] == []
    assert parsed["not_found"]


@pytest.mark.slow
def test_a_recording_without_any_depth_will_do(photograph: Path, meshes: Path, tmp_path: Path) -> None:
    """The user says how the camera stands, and the lamp is found."""
    bare = without_depth(photograph, tmp_path / "bare.mcap")
    result = parse(bare, meshes, tmp_path / "run", "--table", "0.482,40")
    assert result.exit_code == 0, result.output
    parsed = json.loads((tmp_path / "run" / "summary.json").read_text())["parse"]
    assert {one["name"] for one in parsed["objects"]} == {"cube", "cylinder"}


def test_mistakes_are_told_in_one_line(photograph: Path, meshes: Path, tmp_path: Path) -> None:
    """No table, a camera that looks up, half a table, no such frame, several frames, depth wanted."""
    bare = without_depth(photograph, tmp_path / "bare.mcap")
    for number, (more, code, told) in enumerate(
        [
            ((), 1, "stands over the table with --table"),
            (("--table", "0.5,-10"), 1, "pitch between 0 and 90 degrees"),
            (("--table", "0.5"), 2, "HEIGHT,PITCH"),
            (("--table", "0.5,40", "--frames", "9"), 1, "no frame 9"),
            (("--table", "0.5,40", "--frames", "0:2"), 1, "reads one frame"),
            (("--colour", "off"), 1, "has no depth"),
        ]
    ):
        result = parse(bare, meshes, tmp_path / f"run{number}", *more)
        assert result.exit_code == code, told
        assert told in result.output
        assert "Traceback" not in result.output


def test_the_setting_is_the_option(photograph: Path, meshes: Path, tmp_path: Path) -> None:
    """Of the command and of a project: frames of colour alone are read, and no path is looked for."""
    bare = without_depth(photograph, tmp_path / "bare.mcap")
    command = ["parse", str(bare), "--shapes", str(meshes), "-o", str(tmp_path / "run"), "-q"]
    asked = CliRunner().invoke(voxscene, [*command, "-s", "parse.colour=only"])
    project = tmp_path / "project.toml"
    entry = f"[[recording]]\npath = '{bare.name}'\nstage = 'parse'\nshapes = '{meshes}'\n"
    project.write_text(f"{entry}parse.colour = 'only'\n")
    ran = CliRunner().invoke(voxscene, ["run", str(project)])

    for result, told in ((asked, asked.stderr), (ran, ran.stdout)):
        assert result.exit_code == 1
        assert "shows no table and records no pose" in told, result.output
    project.write_text(f"{entry}parse.colour = 'none'\n")
    mistakes = CliRunner().invoke(voxscene, ["run", str(project), "-q"]).stderr.splitlines()
    assert sum("parse.colour" in line for line in mistakes) == 1


def test_grey_clipped_and_unstable_things_are_told(photograph: Path, meshes: Path, tmp_path: Path) -> None:
    """One channel of three, half the image overexposed, a cylinder that would lie: a line each."""
    world = air_world(48, 48)
    scene = air_scene(world, SEED)
    grey = scene.image.mean(axis=-1, keepdims=True).repeat(3, axis=2)
    grey[:24] = 1.0
    write_air_scene(world, replace(scene, image=grey), tmp_path / "grey.mcap")
    result = parse(tmp_path / "grey.mcap", meshes, tmp_path / "grey", "--light", "-0.4,-0.5,0.77,0.4")
    assert result.exit_code == 0, result.output
    assert "frame 0 is grey: its three channels count as one" in result.output
    assert "50% of the pixels of frame 0 are under- or overexposed" in result.output

    (tmp_path / "leaning").mkdir()
    leaning = air_meshes()["cylinder"]
    leaning.apply_transform(trimesh.transformations.rotation_matrix(0.3, [1, 0, 0]))
    leaning.export(tmp_path / "leaning" / "pen.ply")
    result = parse(photograph, tmp_path / "leaning", tmp_path / "run")
    assert result.exit_code == 1, result.output
    assert "pen would not stand with its own z up" in result.output
    assert "Traceback" not in result.output


def film(path: Path, *, with_colour: bool) -> Path:
    """One depth frame of a can on a table."""
    scene = TableScene(room=RoomConfig(kind="none"), path=PathConfig(frames=1, radius_m=0.8), objects=1)
    table = film_table({"can": built_in_object("can")}, scene, 4)
    with RecordingWriter(path, table.intrinsics) as writer:
        frame = table.frame(0)
        writer.write_depth(frame if with_colour else replace(frame, rgb=None))
    return path


def test_what_adding_colour_needs(tmp_path: Path) -> None:
    """A frame without colour and shapes without any are told in a line; nothing is parsed."""
    (tmp_path / "bare").mkdir()
    built_in_object("can").export(tmp_path / "bare" / "can.ply")
    for with_colour, told in (
        (True, "none of the shapes has colours (can)"),
        (False, "has no colour that is registered"),
    ):
        recording = film(tmp_path / f"{with_colour}.mcap", with_colour=with_colour)
        more = ["--shapes", str(tmp_path / "bare"), "-o", str(tmp_path / f"run {with_colour}"), "--quiet"]
        result = CliRunner().invoke(voxscene, ["parse", str(recording), *more, "--colour", "add"])
        assert result.exit_code == 1, result.output
        assert told in result.output
        assert "Traceback" not in result.output


def test_no_weight_is_no_colour() -> None:
    """Then nothing of the parse looks at colours: its bytes are those of --colour off."""
    assert ParseConfig(colour="add").adds_colour
    assert not ParseConfig(colour="add", colour_weight=0.0).adds_colour
    assert not ParseConfig().adds_colour
