"""A picture of a run without a screen: Rerun's viewer, headless, on a Vulkan driver."""

from __future__ import annotations

import io
import os
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from pipeline.atomic import atomic_path
from pipeline.errors import PipelineError
from pipeline.views.timelines import FRAME

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

START_S = 30.0
LOAD_S = 60.0
SETTLE_S, PAINT_S = 40.0, 120.0
FADING_PAINTS = 10
"""Pop-ups fade with each picture that is painted and not with the clock: after seven they were gone."""
TOP_BAR_PX = 44
"""Height of the viewer's own bar."""
CRASH_S = 3.0
"""Within which a viewer whose connection broke has ended, if it ends."""
SOFTWARE_DRIVER = Path("/usr/share/vulkan/icd.d/lvp_icd.x86_64.json")
NO_VULKAN = (
    "Rerun's viewer found no Vulkan driver; install one with "
    "apt-get install mesa-vulkan-drivers libvulkan1, or open the run on a machine with a screen"
)


def take_screenshot(rrds: Sequence[Path], picture: Path, size: tuple[int, int], frame: int | None) -> None:
    """Write a PNG of Rerun recordings as their blueprint shows them.

    Args:
        rrds: files to open, of any kind that Rerun reads; the last is shown.
        picture: the PNG.
        size: width and height in pixels.
        frame: position on the timeline `frame`; None is its end.

    Raises:
        PipelineError: the viewer did not start, nothing could be drawn, or there is no such frame.
    """
    with shown(rrds, size, frame) as viewer:
        image = settled_picture(viewer)
    with atomic_path(picture) as partial:
        partial.write_bytes(_without_top_bar(image))


@contextmanager
def shown(rrds: Sequence[Path], size: tuple[int, int], frame: int | None) -> Iterator[ViewerClient]:
    """A headless viewer that has loaded recordings, at a frame; for `settled_picture`.

    Raises:
        PipelineError: as `take_screenshot`.
    """
    numbers = [] if frame is None else frames_in(rrds[-1])
    if frame is not None and not (numbers and numbers[0] <= frame <= numbers[-1]):
        there = f"it shows {numbers[0]} to {numbers[-1]}" if numbers else "it shows no frames"
        raise PipelineError(f"{rrds[-1]} has no frame {frame}: {there}")
    with _headless_viewer((size[0], size[1] + TOP_BAR_PX)) as port:
        from rerun.experimental import ViewerClient

        viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        for rrd in rrds:
            viewer.open(str(rrd.resolve()))
        deadline = time.monotonic() + LOAD_S
        while not (state := viewer.get_state()).views or state.loading:
            if time.monotonic() > deadline:
                raise PipelineError(f"Rerun's viewer did not load {rrds[-1]} in {LOAD_S:.0f} s")
            time.sleep(0.2)
        if frame is not None:
            viewer.set_time(FRAME, sequence=frame, play_state="paused")
        yield viewer


def settled_picture(viewer: ViewerClient) -> bytes:
    """A PNG of the whole window once images have arrived and pop-ups are gone."""
    deadline = time.monotonic() + SETTLE_S
    before, image, paints = b"", _painted(viewer), 1
    while (paints < FADING_PAINTS or image != before) and time.monotonic() < deadline:
        before, image, paints = image, _painted(viewer), paints + 1
    return image


def _painted(viewer: ViewerClient) -> bytes:
    """A picture as it is now; the viewer gives up after 15 s, a busy machine may need longer."""
    deadline = time.monotonic() + PAINT_S
    while True:
        try:
            return viewer.take_screenshot()
        except TimeoutError as error:
            if time.monotonic() > deadline:
                raise PipelineError(f"Rerun's viewer painted no picture in {PAINT_S:.0f} s") from error


def frames_in(rrd: Path) -> list[int]:
    """Numbers of the first and the last frame at which something was logged; empty without."""
    from rerun.chunk import RrdReader

    numbers: list[int] = []
    for chunk in RrdReader(rrd).stream():
        if FRAME in chunk.timeline_names:
            batch = chunk.to_record_batch()
            found = batch.column(batch.schema.get_field_index(FRAME)).to_numpy(zero_copy_only=False)
            numbers += [int(found.min()), int(found.max())]
    return [min(numbers), max(numbers)] if numbers else []


def _without_top_bar(png: bytes) -> bytes:
    """The window below the viewer's own bar, which tells of the machine and not of the run."""
    image = Image.open(io.BytesIO(png))
    written = io.BytesIO()
    image.crop((0, TOP_BAR_PX, image.width, image.height)).save(written, "PNG")
    return written.getvalue()


@contextmanager
def _headless_viewer(size: tuple[int, int]) -> Iterator[int]:
    """Run the viewer without a window; gives its port on this machine alone."""
    import rerun_cli

    program = Path(rerun_cli.__file__).parent / "rerun"
    environment = dict(os.environ, WGPU_BACKEND="vulkan", CI="1")
    if SOFTWARE_DRIVER.exists():
        environment.setdefault("VK_ICD_FILENAMES", str(SOFTWARE_DRIVER))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = ["--headless", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"]
    arguments += ["--window-size", f"{size[0]}x{size[1]}", "--memory-limit", "2GB"]
    viewer = subprocess.Popen(
        [program, *arguments], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        _wait_for(viewer, port)
        yield port
    except (RuntimeError, ConnectionError, ValueError) as error:
        with suppress(subprocess.TimeoutExpired):
            viewer.wait(CRASH_S)
        raise PipelineError(NO_VULKAN if viewer.poll() is not None else f"Rerun's viewer: {error}") from error
    finally:
        viewer.terminate()
        with suppress(subprocess.TimeoutExpired):
            viewer.wait(5)
        viewer.kill()


def _wait_for(viewer: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if viewer.poll() is not None:
            raise PipelineError(NO_VULKAN)
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.2):
            return
        time.sleep(0.1)
    raise PipelineError(f"Rerun's viewer did not start in {START_S:.0f} s")
