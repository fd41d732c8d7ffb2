"""The parsed scene: objects where they were found, how sure that is, and what rests on what."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import trimesh
from numpy.typing import NDArray

from pipeline.colours import TABLE as TABLE_COLOUR
from pipeline.colours import UNSEEN, WHITE, object_colours
from pipeline.publishing.told_spread import label_text
from pipeline.publishing.values import RunValues
from pipeline.surfaces import SceneSurface, Surfaces
from pipeline.views.labels import Flag
from pipeline.views.trajectory_view import ENLARGED, THIN_WIDTH, quaternions_xyzw
from scene.result import SceneResult
from shapes.geometry.poses import matrices_of, transform_points

LETTER_PX, LINE_PX, PAD_PX = 8, 28, 12
"""Of the graph's nodes: width of a letter, height, and what their boxes add to the width."""
LEVEL_PX, STAGGER_PX = 170, 44
"""Height of a level, and by how much every second node is raised."""
TOLD_AT = 0.64, 0.55, 0.46, 0.72, 0.37, 0.8, 0.28
"""Where on an edge its probability may stand, from the parent on: the first place that is free."""
LIKELY = 0.05
"""Edges at least as probable are drawn, with their probabilities, and objects that nobody sees."""
LABEL_RADIUS_M = 1e-4
CHI_95 = 2.796
"""Radius of the 95% region of a normal distribution in three dimensions, in standard deviations."""
SHARP_RAD = math.radians(60)
"""Angle between faces from which on their edge is drawn sharp: no edge of a learned surface's cells is."""
GHOSTS = 20
"""Samples of the posterior that are drawn as outlines."""
ABOVE = 1.3
"""Radii of the bounding box above an object's middle where its label and ellipsoid stand, outside of it."""


def object_path(name: str) -> str:
    """Entity of an object that was found; what Rerun's paths cannot hold in its name is escaped."""
    return f"world/objects/{rr.escape_entity_path_part(name)}"


def log_scene(
    recording: rr.RecordingStream,
    values: RunValues,
    scene: SceneResult,
    surfaces: Surfaces,
    flags: Mapping[str, Flag],
) -> None:
    """Objects that were found, in the room: surface, samples of the posterior, ellipsoid, label; the graph.

    Args:
        recording: where to.
        values: of the run.
        scene: its parsed scene.
        surfaces: of the objects.
        flags: labels of the objects that were found, by name.
    """
    for one, colour in object_colours(scene.found).items():
        name = str(scene.names[one])
        path = object_path(name)
        surface = surfaces.by_name[name]
        pose = values.reference_from_parsed @ scene.camera_from_object[one]
        recording.log(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static=True)
        recording.log(f"{path}/surface", _mesh(surface, colour), static=True)
        samples = np.linalg.inv(scene.camera_from_object[one]) @ matrices_of(scene.sample_poses[:, one])
        recording.log(f"{path}/samples", _outlines(samples, surface, colour), static=True)
        _log_flag(recording, values, scene, one, surface, flags[name])
    _log_hidden(recording, values, scene, surfaces)
    _log_graph(recording, scene)


def flags_of(
    values: RunValues, scene: SceneResult, surfaces: Surfaces, parse: Mapping[str, Any]
) -> dict[str, Flag]:
    """Labels of the objects that were found, by name, each just above its object.

    Args:
        values: of the run.
        scene: its parsed scene.
        surfaces: of the objects.
        parse: of summary.json.
    """
    told = {one["name"]: label_text(one) for one in parse["objects"]}
    flags = {}
    for name, camera_from_object in scene.found_poses:
        pose, surface = values.reference_from_parsed @ camera_from_object, surfaces.by_name[name]
        foot_m = pose[:3, :3] @ surface.middle_m + pose[:3, 3]
        flags[name] = Flag(text=told[name], foot_m=foot_m, height_m=ABOVE * surface.radius_m)
    return flags


def found_places_m(scene: SceneResult, surfaces: Surfaces, up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of the boxes of what was found and their labels (F * 9, 3), in the first camera parsed.

    Args:
        scene: as parsed.
        surfaces: of the objects.
        up: unit vector (3,) in that camera.
    """
    corners = []
    for name, pose in scene.found_poses:
        surface = surfaces.by_name[name]
        box = np.stack([surface.vertices_m.min(axis=0), surface.vertices_m.max(axis=0)])
        eight = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
        corners.append(transform_points(pose, eight))
        corners.append(corners[-1].mean(axis=0, keepdims=True) + ABOVE * surface.radius_m * up)
    return np.concatenate(corners)


def _log_hidden(
    recording: rr.RecordingStream, values: RunValues, scene: SceneResult, surfaces: Surfaces
) -> None:
    """Outlines of where objects that nobody sees may be, behind what hides them, a label at the first."""
    hidden = scene.presence_out_of_sight
    for one in np.flatnonzero(~scene.found & (scene.hidden_share > 0) & (hidden >= LIKELY)).tolist():
        name, surface = str(scene.names[one]), surfaces.by_name[str(scene.names[one])]
        poses = values.reference_from_parsed @ matrices_of(scene.hidden_poses[one])
        path, colour = f"world/hidden/{rr.escape_entity_path_part(name)}", UNSEEN
        recording.log(f"{path}/samples", _outlines(poses, surface, colour), static=True)
        label = rr.Points3D(
            [poses[0, :3, :3] @ surface.middle_m + poses[0, :3, 3]],
            radii=LABEL_RADIUS_M,
            colors=WHITE,
            labels=f"{name} {hidden[one]:.0%}, not seen",
        )
        recording.log(f"{path}/label", label, static=True)


def _outlines(
    samples: NDArray[np.float64], surface: SceneSurface, colour: tuple[int, int, int]
) -> rr.Boxes3D:
    """Bounding boxes of some samples (S, 4, 4), evenly chosen."""
    poses = samples[np.unique(np.linspace(0, len(samples) - 1, GHOSTS).round().astype(int))]
    return rr.Boxes3D(
        centers=poses[:, :3, :3] @ surface.middle_m + poses[:, :3, 3],
        half_sizes=np.tile(np.ptp(surface.vertices_m, axis=0) / 2, (len(poses), 1)),
        quaternions=quaternions_xyzw(poses[:, :3, :3]),
        colors=(*colour, 90),
        radii=THIN_WIDTH,
        fill_mode="majorwireframe",
    )


def _log_flag(
    recording: rr.RecordingStream,
    values: RunValues,
    scene: SceneResult,
    one: int,
    surface: SceneSurface,
    flag: Flag,
) -> None:
    """Label and 95% region of an object's middle, above it, where nothing hides them; a line leads there."""
    path, colour = object_path(str(scene.names[one])), object_colours(scene.found)[one]
    reference_from_object = values.reference_from_parsed @ scene.camera_from_object[one]
    above = surface.middle_m + flag.height_m * reference_from_object[:3, :3].T @ values.up
    own = scene.camera_from_object[one, :3, :3]
    variances, axes = np.linalg.eigh(own.T @ scene.covariance_of_point(one, surface.middle_m) @ own)
    axes *= np.sign(np.linalg.det(axes))
    for name, scale in (("uncertainty", 1.0), ("uncertainty_10x", ENLARGED)):
        ellipsoid = rr.Ellipsoids3D(
            centers=[above],
            half_sizes=[scale * CHI_95 * np.sqrt(np.maximum(variances, 0))],
            quaternions=quaternions_xyzw(axes[None]),
            colors=colour,
            fill_mode="solid" if scale == 1 else "majorwireframe",
        )
        recording.log(f"{path}/{name}", ellipsoid, static=True)
    pole = rr.LineStrips3D([[surface.middle_m, above]], colors=(*colour, 160), radii=THIN_WIDTH)
    recording.log(f"{path}/pole", pole, static=True)
    label = rr.Points3D([above], radii=LABEL_RADIUS_M, colors=WHITE, labels=flag.text)
    recording.log(f"{path}/label", label, static=True)


def _log_graph(recording: rr.RecordingStream, scene: SceneResult) -> None:
    """What rests on what; each edge leads through a small node that tells its probability."""
    colours = object_colours(scene.found)
    names = [*map(str, scene.names), *scene.supports]
    nodes = [*colours, *range(len(scene.names), len(names))]
    labels = [names[node] for node in nodes]
    places = dict(zip(nodes, _node_places(scene, labels), strict=True))
    edges = [
        (child, int(parent))
        for child in colours
        for parent in np.flatnonzero(scene.edge_probabilities[child] >= LIKELY)
        if int(parent) in places
    ]
    told = [f"{scene.edge_probabilities[edge]:.0%}" for edge in edges]
    between = [f"{names[child]} on {names[parent]}" for child, parent in edges]
    ends = [(places[child], places[parent]) for child, parent in edges]
    middles = _places_on_edges(ends, told, _boxes(list(places.values()), labels))
    recording.log(
        "graph",
        rr.GraphNodes(
            labels + between,
            positions=np.array([*places.values(), *middles]),
            labels=labels + told,
            colors=[*colours.values(), *[TABLE_COLOUR] * len(scene.supports), *[WHITE] * len(edges)],
        ),
        rr.GraphEdges(
            [
                link
                for (child, parent), middle in zip(edges, between, strict=True)
                for link in ((names[child], middle), (middle, names[parent]))
            ],
            graph_type="directed",
        ),
        static=True,
    )


def _node_places(scene: SceneResult, labels: Sequence[str]) -> NDArray[np.float64]:
    """Pixels (F + S, 2) of the nodes of what was found and of the supports, which are the last.

    Drawn as the most probable scene stands: the supports below, what rests on a thing above it. Neighbours
    alternate in height, so that they may come closer than their labels are wide.
    """
    found = np.flatnonzero(scene.found).tolist()
    supports = [len(scene.names) + number for number in range(len(scene.supports))]
    nodes = [*found, *supports]
    parents = scene.sample_parents[np.argmax(scene.sample_log_posteriors)]
    resting = {node: [one for one in found if parents[one] == node] for node in nodes}
    floating = [one for one in found if parents[one] not in nodes]
    closest = max(map(len, [*labels, "100%"])) * LETTER_PX / 2 + 2 * PAD_PX
    columns, raised = itertools.count(), defaultdict(lambda: itertools.cycle((0, STAGGER_PX)))
    places: dict[int, tuple[float, float]] = {}

    def place(node: int, level: int) -> float:
        above = [place(one, level + 1) for one in resting[node]]
        column = sum(above) / len(above) if above else next(columns)
        places[node] = closest * column, -LEVEL_PX * level - next(raised[level])
        return column

    for one in supports:
        place(one, 0)
    for one in floating:
        place(one, 1)
    return np.array([places[node] for node in nodes])


def graph_bounds(scene: SceneResult) -> NDArray[np.float64]:
    """Corners (2, 2) of the graph, its labels included; pixels."""
    found = [str(name) for name, there in zip(scene.names, scene.found, strict=True) if there]
    labels = [*found, *scene.supports]
    boxes = _boxes(_node_places(scene, labels), labels)
    return np.stack([boxes[:, 0].min(axis=0) - PAD_PX, boxes[:, 1].max(axis=0) + PAD_PX])


def _boxes(
    places: Sequence[NDArray[np.float64]] | NDArray[np.float64], labels: Sequence[str]
) -> NDArray[np.float64]:
    """Corners (N, 2, 2) of the boxes of nodes; pixels."""
    half = np.array([[LETTER_PX * len(label) / 2 + PAD_PX, LINE_PX / 2] for label in labels])
    return np.stack([places - half, places + half], axis=1)


def _places_on_edges(
    ends: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
    told: Sequence[str],
    taken: NDArray[np.float64],
) -> list[NDArray[np.float64]]:
    """Where the probability of each edge, from child to parent, covers no box of `taken` and no other one."""
    places = []
    for (child, parent), text in zip(ends, told, strict=True):
        shares = np.array(TOLD_AT)[:, None]
        boxes = _boxes(parent + shares * (child - parent), [text] * len(TOLD_AT))
        covers = (boxes[:, None, 0] < taken[:, 1]) & (taken[:, 0] < boxes[:, None, 1])
        free = int(covers.all(axis=-1).any(axis=-1).argmin())
        places.append(boxes[free].mean(axis=0))
        taken = np.concatenate([taken, boxes[free][None]])
    return places


def _mesh(surface: SceneSurface, colour: tuple[int, int, int]) -> rr.Mesh3D:
    """A surface with smooth normals but for its edges, which are drawn sharp."""
    whole = trimesh.Trimesh(surface.vertices_m, surface.faces, process=False)
    drawn = trimesh.graph.smooth_shade(whole, angle=SHARP_RAD)
    return rr.Mesh3D(
        vertex_positions=drawn.vertices,
        triangle_indices=drawn.faces,
        vertex_normals=drawn.vertex_normals,
        albedo_factor=colour,
    )
