"""A picture of a run without a screen: Rerun's viewer, headless, on a Vulkan driver."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.atomic import atomic_path
from pipeline.errors import PipelineError

START_S = 30.0
LOAD_S = 60.0
SETTLE_S = 8.0
"""Software rendering is slow, and pop-ups need time to fade."""
SOFTWARE_DRIVER = Path("/usr/share/vulkan/icd.d/lvp_icd.x86_64.json")
NO_VULKAN = (
    "Rerun's viewer found no Vulkan driver; install one with "
    "apt-get install mesa-vulkan-drivers libvulkan1, or open the run on a machine with a screen"
)


def take_screenshot(rrds: Sequence[Path], picture: Path, size: tuple[int, int], frame: int | None) -> None:
    """Write a PNG of Rerun recordings as their blueprint shows them.

    Args:
        rrds: files to open.
        picture: the PNG.
        size: width and height in pixels.
        frame: position on the timeline `frame`; None is its end.

    Raises:
        PipelineError: the viewer did not start, or nothing could be drawn.
    """
    with _headless_viewer(size) as port:
        from rerun.experimental import ViewerClient

        viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        for rrd in rrds:
            viewer.open(str(rrd))
        deadline = time.monotonic() + LOAD_S
        while not (state := viewer.get_state()).views or state.loading:
            if time.monotonic() > deadline:
                raise PipelineError(f"Rerun's viewer did not load {rrds[0]} in {LOAD_S:.0f} s")
            time.sleep(0.2)
        if frame is not None:
            viewer.set_time("frame", sequence=frame, play_state="paused")
        time.sleep(SETTLE_S)
        image = viewer.take_screenshot()
    with atomic_path(picture) as partial:
        partial.write_bytes(image)


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
