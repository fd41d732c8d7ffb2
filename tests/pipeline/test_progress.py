"""Progress shows rate and remaining time, and only for long work."""

import io
import re
import time

from pipeline.progress import Progress, tell


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        """It is."""
        return True


class Clock:
    """A clock set by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        """Seconds."""
        return self.now_s


def shown(stream: io.StringIO, seconds_and_done: list[tuple[float, int]], *, quiet: bool = False) -> str:
    """What stands on the stream after these calls of a work of 60 frames."""
    clock = Clock()
    with Progress("slam", "frames", quiet=quiet, stream=stream, clock=clock) as progress:
        for seconds, done in seconds_and_done:
            clock.now_s = 100.0 + seconds
            progress(done, 60)
    return stream.getvalue()


def test_short_work_is_silent() -> None:
    """Nothing within two seconds, on terminals and files."""
    for stream in (Terminal(), io.StringIO()):
        assert shown(stream, [(0.1, 3), (1.9, 59)]) == ""


def test_a_terminal_has_one_line_that_is_wiped_at_the_end() -> None:
    """Rate and remaining time."""
    text = shown(Terminal(), [(2.0, 4), (2.05, 5), (3.0, 12), (4.0, 20)])

    assert text.count("\r") == 5
    assert "\rslam: 4/60 frames\r" in text
    assert "\rslam: 20/60 frames, 8/s, 0:05 left" in text
    assert text.endswith("\r")
    assert "\n" not in text


def test_a_file_gets_a_line_now_and_then() -> None:
    """After two seconds, then every ten."""
    text = shown(io.StringIO(), [(2.0, 4), (5.0, 9), (12.0, 24)])

    assert text == "slam: 4/60 frames\nslam: 24/60 frames, 2/s, 0:18 left\n"


def test_the_rate_does_not_count_what_comes_before_the_first_call() -> None:
    """Compiling took nine seconds, ten frames eleven."""
    text = shown(io.StringIO(), [(9.0, 1), (20.0, 11)])

    assert text == "slam: 1/60 frames\nslam: 11/60 frames, 0.909/s, 0:54 left\n"


def test_pauses_to_compile_do_not_count() -> None:
    """Frames of a tenth of a second, the second and the tenth after five: it is fifty frames from the end."""
    seconds, calls = 0.0, []
    for done in range(1, 11):
        seconds += 5.0 if done in {2, 10} else 0.1
        calls.append((seconds, done))

    text = shown(Terminal(), calls)

    assert text.count("left") > 2
    assert set(re.findall(r"0:\d\d left", text)) <= {"0:06 left", "0:05 left"}
    assert "10/60 frames, 10/s, 0:05 left" in text


def test_quiet_shows_nothing() -> None:
    """However long."""
    assert shown(Terminal(), [(200.0, 3)], quiet=True) == ""


def test_an_unknown_total_shows_the_rate_alone() -> None:
    """And hours are written as hours where the total is known."""
    clock, stream = Clock(), io.StringIO()
    progress = Progress("read", "frames", stream=stream, clock=clock)
    progress(0)
    clock.now_s += 9
    progress(18)
    clock.now_s += 10
    progress(24, 24 + 7200)

    assert stream.getvalue() == "read: 18 frames, 2/s\nread: 24/7224 frames, 0.6/s, 3:20:00 left\n"


def test_the_remaining_time_is_that_of_the_last_seconds() -> None:
    """Ten slow frames, while kernels are compiled, do not count for the fast ones after them."""
    slow = [(seconds, seconds // 3) for seconds in range(0, 31, 3)]
    fast = [(30 + number / 10, 10 + number) for number in range(1, 101)]
    clock, stream = Clock(), Terminal()
    progress = Progress("slam", "frames", stream=stream, clock=clock)
    for seconds, done in [*slow, *fast]:
        clock.now_s = 100.0 + seconds
        progress(done, 1110)

    assert stream.getvalue().rstrip().endswith("10/s, 1:40 left")


def test_the_program_lives_between_calls() -> None:
    """A thread shows the phase within three seconds, where nothing is counted yet."""
    stream = io.StringIO()
    with Progress("slam", "frames", stream=stream) as progress:
        progress.phase("compiling once for 640x480")
        time.sleep(2.6)

    assert stream.getvalue() == "slam: compiling once for 640x480, 0:02\n"


def test_what_is_printed_does_not_stand_behind_the_line(capsys) -> None:
    """The terminal's line is wiped before."""
    clock, stream = Clock(), Terminal()
    with Progress("slam", "frames", stream=stream, clock=clock) as progress:
        clock.now_s += 3.0
        progress(12, 60)
        tell("none lost")
        assert stream.getvalue() == "\rslam: 12/60 frames\r" + " " * len("slam: 12/60 frames") + "\r"

    assert capsys.readouterr().out == "none lost\n"


def test_a_line_is_no_longer_than_the_terminal_is_wide(monkeypatch) -> None:
    """A longer one would wrap, and could not be wiped; its end is what counts."""
    monkeypatch.setenv("COLUMNS", "20")
    text = shown(Terminal(), [(2.0, 4)])
    clock, stream = Clock(), Terminal()
    with Progress("recordings/of_a_long_name.mcap", "frames", stream=stream, clock=clock) as progress:
        clock.now_s += 3.0
        progress(12, 60)

    assert "\rslam: 4/60 frames\r" in text
    assert "\r...ap: 12/60 frames\r" in stream.getvalue()
