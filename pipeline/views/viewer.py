"""Finding the views of a run, and opening them on a screen."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.evaluation.same_recording import check_truth, truth_options
from pipeline.fingerprints import file_hash
from pipeline.logs import log
from pipeline.publishing.publish import tells_committed_values
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder, check_one_recording
from pipeline.views.rrd import write_rrd
from pipeline.views.truth_view import truth_of
from recordings.attached import save_attachments

ONLY_HERE = "127.0.0.1"
"""Address at which no other machine reaches a viewer."""


def rrds_of(path: Path, *, rebuild: bool = False) -> list[Path]:
    """The run.rrd of a run folder, and of every recording in it; made where it is missing or stale."""
    found = []
    for folder in [path, *sorted(path.glob("recordings/*"))]:
        run = RunFolder(folder, force=False)
        for sentence in run.changed:
            log.warning("%s: %s", folder, sentence)
        if not run.records():
            continue
        rrd = folder / "run.rrd"
        if rebuild or not rrd.exists() or not tells_committed_values(run):
            write_rrd(rrd, folder.resolve().name, RunValues.load(run).drawable, run.identity)
        found.append(rrd)
    return found


def rrd_with_truth(path: Path, truth: Path) -> Path:
    """The views of a run beside the truth that a recording or a TUM file holds, as run.truth.rrd in it.

    Raises:
        RecordingError: the truth cannot be read.
        PipelineError: there is no run, or no truth of it, or that of another recording.
    """
    check_one_recording(path)
    run = RunFolder(path)
    if not run.records():
        raise PipelineError(f"{path} holds no run of one recording; --truth shows one beside its truth")
    rrd, values = path / "run.truth.rrd", RunValues.load(run).drawable
    known = truth_of(values, truth, truth_options(run, "slam", "parse"))
    check_truth(run, truth)
    write_rrd(rrd, f"{path.resolve().name}, truth", values, f"{run.identity}-truth", known)
    return rrd


def rrd_of_mcap(mcap: Path) -> Path:
    """The views of a run whose run.mcap alone is at hand, made beside it under its name.

    Raises:
        RecordingError: the file cannot be read.
        PipelineError: it holds no values of a run.
    """
    rrd = mcap.with_suffix(".rrd")
    with tempfile.TemporaryDirectory() as folder:
        paths = save_attachments(mcap, Path(folder))
        if not paths:
            raise PipelineError(f"{mcap} holds no values of a run; --from-mcap takes the run.mcap of a run")
        files = {path.relative_to(folder).as_posix(): path for path in paths}
        write_rrd(rrd, mcap.resolve().parent.name, RunValues.of_files(files).drawable, file_hash(mcap)[:8])
    return rrd


def open_viewer(rrds: Sequence[Path]) -> None:
    """Open Rerun recordings in the viewer and wait until it is closed.

    Raises:
        PipelineError: there is no screen, or the viewer failed.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise PipelineError(
            "there is no screen here; look at it in a browser with --web, take a picture with "
            f"--screenshot OUT.png, or open {rrds[-1]} with `rerun` on another machine"
        )
    ended = subprocess.run([_program(), "--bind", ONLY_HERE, *rrds], check=False)
    if ended.returncode != 0:
        raise PipelineError(
            f"Rerun's viewer ended with code {ended.returncode}; look at it in a browser with --web, or take "
            "a picture with --screenshot OUT.png"
        )


def serve_viewer(rrds: Sequence[Path], port: int, say: Callable[[str], None]) -> None:
    """Serve Rerun recordings to a browser on this machine until interrupted.

    Args:
        rrds: files.
        port: of the page; the next one carries the data.
        say: told the page's address.

    Raises:
        PipelineError: the server ended by itself.
    """
    arguments = [
        "--serve-web",
        "--bind",
        ONLY_HERE,
        "--web-viewer-port",
        str(port),
        "--port",
        str(port + 1),
    ]
    environment = dict(os.environ, CI="1", RUST_LOG="warn")
    server = subprocess.Popen([_program(), *arguments, *rrds], env=environment)
    say(f"http://{ONLY_HERE}:{port}/?url=rerun%2Bhttp://{ONLY_HERE}:{port + 1}/proxy")
    try:
        if server.wait() != 0:
            raise PipelineError(f"Rerun could not serve; is port {port} or {port + 1} in use? name another")
    except KeyboardInterrupt:
        pass
    finally:
        server.terminate()
        with suppress(subprocess.TimeoutExpired):
            server.wait(5)
        server.kill()


def _program() -> Path:
    """The viewer itself, not the script that starts it."""
    import rerun_cli

    return Path(rerun_cli.__file__).parent / "rerun"
