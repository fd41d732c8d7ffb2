"""Outlines lie on the object's border, dotted where something is nearer."""

import numpy as np
import trimesh

from pipeline.figures.canvas import panels
from pipeline.figures.overlays import Outline, draw_overlay
from recordings.types import CameraIntrinsics, Frame

LENS = CameraIntrinsics(width=80, height=60, fx=80.0, fy=80.0, cx=39.5, cy=29.5)


def test_hidden_edges_are_dotted_and_the_label_stands_once() -> None:
    """A box of 20 pixels whose left half is behind something."""
    pose = np.eye(4)
    pose[2, 3] = 1.0
    depth = np.full((60, 80), 2.0, np.float32)
    depth[:, :40] = 0.5
    mesh = trimesh.creation.box((0.25, 0.25, 1e-3))
    outline = Outline(mesh=mesh, camera_from_mesh=pose, colour="white", label="truth")
    figure, axes = panels(1, 1, 2.0, 2.0)
    draw_overlay(axes[0][0], Frame(time_ns=0, depth_m=depth), LENS, [outline, outline])
    lines = axes[0][0].get_lines()
    drawn = {
        style: np.concatenate(
            [np.stack(line.get_data(), 1) for line in lines if line.get_linestyle() == style]
        )
        for style in ("-", ":")
    }
    seen, hidden = (points[np.isfinite(points).all(axis=1)] for points in drawn.values())

    assert seen[:, 0].min() > 38
    assert hidden[:, 0].max() < 41
    assert np.abs(seen[:, 0].max() - (39.5 + 10)) < 1.1
    assert np.abs(hidden[:, 0].min() - (39.5 - 10)) < 1.1
    assert len(axes[0][0].get_legend_handles_labels()[1]) == 1
    assert figure is not None


def test_what_is_out_of_sight_is_left_out() -> None:
    """Nothing is drawn of an object behind the camera or beside the image."""
    pose = np.eye(4)
    pose[:3, 3] = 5.0, 0.0, 1.0
    outline = Outline(mesh=trimesh.creation.box((0.1,) * 3), camera_from_mesh=pose, colour="red", label="x")
    _, axes = panels(1, 1, 2.0, 2.0)
    frame = Frame(time_ns=0, depth_m=np.ones((60, 80), np.float32), rgb=np.zeros((60, 80, 3), np.uint8))
    draw_overlay(axes[0][0], frame, LENS, [outline])
    assert not axes[0][0].get_lines()
