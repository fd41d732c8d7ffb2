"""The formats that can be imported, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from recordings.errors import RecordingError
from recordings.importers.bag import import_bag
from recordings.importers.bop import read_bop
from recordings.importers.dataset import Dataset, Intrinsics, write_dataset
from recordings.importers.redwood import read_redwood
from recordings.importers.seven_scenes import read_seven_scenes
from recordings.importers.tum import read_tum

DATASETS: dict[str, Callable[[Path, slice], Dataset]] = {
    "tum": read_tum,
    "7scenes": read_seven_scenes,
    "redwood": read_redwood,
    "bop": read_bop,
}
"""The readers of folders of images."""


def import_recording(
    format_: str,
    source: Path,
    out: Path,
    *,
    frames: slice,
    intrinsics: Intrinsics | None,
    progress: Callable[[int, int], None],
) -> tuple[str, ...]:
    """Write what is in `source` as a recording.

    Args:
        format_: a name of `DATASETS`, or `bag`.
        source: a folder or file of that format.
        out: the MCAP file to write.
        frames: which of a folder's frames are wanted; for a bag, all.
        intrinsics: the camera, instead of the one in the folder; for a bag, None.
        progress: is told how much of how much is done.

    Returns:
        Sentences on what was assumed or left out.

    Raises:
        RecordingError: the source is missing, damaged or of another format, or `out` cannot be written
            or is the source.
    """
    if out.exists() and source.exists() and out.samefile(source):
        raise RecordingError(f"{out} is what is imported; name another file to write")
    if format_ == "bag":
        return import_bag(source, out, progress)
    dataset = DATASETS[format_](source, frames)
    if intrinsics is not None:
        dataset = replace(dataset, intrinsics=intrinsics, assumed_intrinsics=())
    write_dataset(dataset, out, progress)
    return dataset.assumptions + dataset.assumed_intrinsics
