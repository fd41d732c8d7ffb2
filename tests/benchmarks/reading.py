"""How fast recordings are read, beside the bare libraries, and what memory that takes with their length.

Run with `python -m tests.benchmarks.reading`; the peer is mcap's reader with checksums and mcap_ros2's
decoder, alone and with the same conversion to metres, on the same file in alternating turns.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image

from recordings.reading import open_recording
from recordings.types import CameraIntrinsics, Frame
from recordings.writer import DEPTH_TOPIC, RecordingWriter

LENGTHS = (500, 5000)
ROUNDS = 7
TARGET_RATIO = 0.8
CAMERA = CameraIntrinsics(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0)


def main() -> None:
    """Write recordings of two lengths, then print speed, ratio and peak memory."""
    with tempfile.TemporaryDirectory() as folder:
        paths = {length: Path(folder) / f"{length}.mcap" for length in LENGTHS}
        for length, path in paths.items():
            write(path, length)
        compare_speed(paths[LENGTHS[0]])
        for length, path in paths.items():
            command = [sys.executable, "-m", "tests.benchmarks.reading", str(path)]
            print(f"{length} frames: {subprocess.check_output(command, text=True).strip()}")


def write(path: Path, length: int) -> None:
    """A recording that repeats twenty frames: real ones if there are any, else noise."""
    images = real_images() or noise_images()
    with RecordingWriter(path, CAMERA, depth_unit_m=0.001) as writer:
        for number in range(length):
            depth_m = images[number % len(images)]
            writer.write_depth(Frame(time_ns=round((1 + number / 30) * 1e9), depth_m=depth_m))
            writer.write_camera_pose(round((1 + number / 30) * 1e9), np.eye(4))


def real_images() -> list[np.ndarray]:
    """Depth in metres from 7-Scenes, if VOXSCENE_DATA has it."""
    folder = Path(os.environ.get("VOXSCENE_DATA", "../shared/data")) / "sevenscenes_redkitchen"
    files = sorted(folder.glob("*.depth.png"))[:20]
    return [np.asarray(Image.open(file)).astype(np.float32) / 1000 for file in files]


def noise_images() -> list[np.ndarray]:
    """A slanted wall with a millimetre of noise."""
    rng = np.random.default_rng(20)
    wall = np.linspace(1.0, 3.0, 640)[None, :] + np.zeros((480, 1))
    return [(wall + rng.normal(0, 0.001, wall.shape)).astype(np.float32) for _ in range(20)]


def read_ours(path: Path) -> int:
    """Frames in metres, as a stage reads them."""
    return sum(1 for _ in open_recording(path))


def read_bare(path: Path, *, metres: bool = False) -> int:
    """Messages decoded by the libraries alone."""
    count = 0
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for *_, message in reader.iter_decoded_messages(topics=[DEPTH_TOPIC]):
            if metres:
                stored = np.frombuffer(message.data, "<u2").reshape(message.height, message.width)
                np.divide(stored, 1000, dtype=np.float32)
            count += 1
    return count


def compare_speed(path: Path) -> None:
    """Frames a second in alternating turns, and the median of the ratios of each turn."""
    readers: dict[str, Callable[[], int]] = {
        "bare": lambda: read_bare(path),
        "bare, in metres": lambda: read_bare(path, metres=True),
        "voxscene": lambda: read_ours(path),
    }
    speeds: dict[str, list[float]] = {name: [] for name in readers}
    for _ in range(ROUNDS):
        for name, read in readers.items():
            begun = time.perf_counter()
            speeds[name].append(read() / (time.perf_counter() - begun))
    for name, found in speeds.items():
        print(f"{name}: {np.median(found):.0f} frames/s (from {min(found):.0f} to {max(found):.0f})")
    for name in ("bare", "bare, in metres"):
        ratio = np.median(np.divide(speeds["voxscene"], speeds[name]))
        print(f"voxscene / {name}: {ratio:.2f} (target {TARGET_RATIO})")


def report_memory(path: Path) -> None:
    """Speed and peak memory of one complete reading, in a process of its own."""
    before = peak_memory_mib()
    begun = time.perf_counter()
    frames = read_ours(path)
    seconds = time.perf_counter() - begun
    peak = peak_memory_mib()
    print(f"{frames / seconds:.0f} frames/s, peak {peak:.0f} MiB, {peak - before:.0f} above the start")


def peak_memory_mib() -> float:
    """Of this program alone, on Linux: getrusage also counts the program that started it."""
    (peak,) = re.findall(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(peak) / 1024


if __name__ == "__main__":
    if len(sys.argv) > 1:
        report_memory(Path(sys.argv[1]))
    else:
        main()
