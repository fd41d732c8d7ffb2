"""Tables drawn from the model of `parse`."""

import numpy as np

from pipeline.synthesis.model_tables import HEIGHT, WIDTH, _is_in_sight, intrinsics


def test_what_is_there_is_in_sight() -> None:
    """Middles count, to the outer edges of the image's pixels, and in front of the camera only."""
    camera = intrinsics()

    def boxes(*pixels: tuple[float, float], ahead_m: float = 0.5) -> np.ndarray:
        poses = np.tile(np.eye(4), (len(pixels), 1, 1))
        middles = [((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0) for u, v in pixels]
        poses[:, :3, 3] = ahead_m * np.array(middles)
        return poses

    inner, outer = (-0.4, HEIGHT - 0.6), (WIDTH - 0.4, 3.0)
    assert _is_in_sight(boxes(inner, (10.0, 10.0)))
    assert not _is_in_sight(boxes(inner, outer))
    assert not _is_in_sight(boxes(inner, ahead_m=-0.5))
