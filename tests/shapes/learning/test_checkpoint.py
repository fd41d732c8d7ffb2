"""Learning that was killed goes on from its checkpoint with the same numbers."""

from dataclasses import fields
from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recordings.types import NO_RETURN, Frame
from shapes.learning.checkpoint import LearnCheckpoint
from shapes.learning.config import LearnConfig
from shapes.learning.distillation import learn_shape
from tests.shapes.views import INTRINSICS, ray_cast

CONFIG = LearnConfig(pitch_m=0.01, box=(-0.1, -0.1, 0.3, 0.1, 0.1, 0.5), views=3, trajectories=2, sweeps=3)


def film() -> tuple[list[Frame], np.ndarray]:
    """Three views of a box, 40 cm away, turned between them; two trajectories that differ by 2 mm."""
    box = trimesh.creation.box((0.08, 0.06, 0.1))
    camera_from_box = np.tile(np.eye(4), (3, 1, 1))
    for pose, angle in zip(camera_from_box, (0.0, 0.4, 0.8), strict=True):
        pose[:3, :3] = Rotation.from_euler("yx", [angle, 0.5]).as_matrix()
        pose[2, 3] = 0.4
    depths = np.nan_to_num(ray_cast(box, camera_from_box), posinf=NO_RETURN)
    frames = [Frame(time_ns=number, depth_m=depth) for number, depth in enumerate(depths)]
    reference_from_camera = camera_from_box[0] @ np.linalg.inv(camera_from_box)
    shifted = reference_from_camera.copy()
    shifted[1:, 0, 3] += 0.002
    return frames, np.stack([reference_from_camera, shifted])


def test_killed_learning_ends_with_the_same_bytes(key: jax.Array, tmp_path: Path) -> None:
    """Through a file, after the first of two trajectories, which is not learned again."""
    frames, trajectories = film()
    arguments = (frames, INTRINSICS, trajectories, np.log([0.5, 0.5]), CONFIG)
    whole = learn_shape(jax.random.clone(key), *arguments)

    def kill(checkpoint: LearnCheckpoint) -> None:
        checkpoint.save(tmp_path / "checkpoint")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn_shape(jax.random.clone(key), *arguments, on_checkpoint=kill)
    done: list[int] = []
    checkpoint = LearnCheckpoint.load(tmp_path / "checkpoint")
    resumed = learn_shape(
        jax.random.clone(key), *arguments, lambda number, _: done.append(number), checkpoint=checkpoint
    )

    assert done == [2]
    assert (whole.phi > 0.5).any()
    assert len(whole.surfels) > 100
    pairs = {
        field.name: (getattr(whole, field.name), getattr(resumed, field.name)) for field in fields(whole)
    }
    one, other = pairs.pop("surfels")
    pairs |= {name: (values, other.arrays[name]) for name, values in one.arrays.items()}
    for name, (one, other) in pairs.items():
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes(), name


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    """By name; learning then begins anew."""
    (tmp_path / "checkpoint").write_bytes(b"PK but no archive")
    with pytest.raises(ValueError, match="checkpoint"):
        LearnCheckpoint.load(tmp_path / "checkpoint")
