"""Masks of pixels that see what moves with the camera: a robot's own body, a gripper, a housing's rim."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recordings.errors import RecordingError


def read_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels (H, W) to leave out: those that are black in an image file.

    Args:
        path: the file, of any format.
        size: width and height that it has to have: those of the depth images.

    Raises:
        RecordingError: the file cannot be read, has another size, or leaves nothing.
    """
    try:
        with Image.open(path) as image:
            if image.size != size:
                width, height = image.size
                raise RecordingError(f"the mask {path} is {width}x{height}, the depth is {size[0]}x{size[1]}")
            left_out = np.asarray(image.convert("L")) == 0
    except RecordingError:
        raise
    except Exception as error:  # Pillow raises half a dozen kinds on damaged images
        raise RecordingError(f"cannot read the mask {path}: {error}") from error
    if left_out.all():
        raise RecordingError(f"the mask {path} is all black: it leaves out every pixel")
    return left_out
