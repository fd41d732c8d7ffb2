"""`voxscene info`: what is in a recording, and is it whole?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from pipeline.damage import describe, report_damage
from pipeline.options import Common, RecordingSource, common_options, recording_options
from pipeline.progress import tell

if TYPE_CHECKING:
    from recordings.overview import DepthCandidate, DepthOverview, Overview, Pace
    from recordings.types import CameraIntrinsics

_GAPS_SHOWN = 5
_PROBLEMS_SHOWN = 10


@click.command(name="info")
@click.option("--hash", "hashes", is_flag=True, help="Add the sha256 of each decoded depth frame.")
@recording_options
@common_options("recording")
@click.pass_context
def command(ctx: click.Context, source: RecordingSource, hashes: bool, common: Common) -> None:
    """Topics, frames, rates, gaps, intrinsics and damage.

    REC is an MCAP file or a rosbag2 folder. Exit code 3 says that part of it is lost.
    """
    from recordings.overview import survey

    overview = survey(source.path, source.read_options(common.settings), hashes=hashes)
    common.report(_document(overview), _lines(overview))
    if overview.depth and not overview.depth.frames and any(source.said[one] for one in ("start_s", "end_s")):
        tell("voxscene: no frame lies between --start and --end", err=True)
    for warning in _document(overview)["warnings"]:
        tell(f"voxscene: {warning}", err=True)
    for problem in overview.problems[:_PROBLEMS_SHOWN]:
        tell(f"voxscene: {problem}", err=True)
    ctx.exit(report_damage(source.path, overview.damage))


def _lines(overview: Overview) -> list[str]:
    lines = [
        *_depth_lines(overview),
        *_attachment_lines(overview),
        "",
        *_topic_lines(overview),
        "",
        _verdict(overview),
    ]
    lines = [_printable(line) for line in lines]
    hashes = overview.depth.frame_hashes if overview.depth else None
    return lines if hashes is None else [*lines, "", *hashes]


def _document(overview: Overview) -> dict[str, Any]:
    depth = overview.depth
    camera = depth.intrinsics if depth else None
    duration_s = (
        depth.pace.duration_s if depth else max((t.pace.duration_s for t in overview.topics), default=0)
    )
    document: dict[str, Any] = {
        "depth_frames": depth.frames if depth else 0,
        "width": depth.size[0] if depth else None,
        "height": depth.size[1] if depth else None,
        **{name: getattr(camera, name, None) for name in ("fx", "fy", "cx", "cy")},
        "duration_s": duration_s,
        "topics": {
            topic.name: {
                "type": topic.schema,
                "encoding": topic.encoding,
                "messages": topic.messages,
                "rate_hz": topic.pace.rate_hz,
            }
            for topic in overview.topics
        },
        "lost_messages": overview.damage.lost_messages,
        "lost_chunks": overview.damage.lost_chunks,
        "verified": overview.damage.verified,
        **_statistics(depth),
    }
    if overview.candidates:
        document["depth_topics"] = {
            one.topic: {
                "width": one.size[0],
                "height": one.size[1],
                "frame_id": one.frame_id,
                "aligned_to_colour": one.aligned,
                "taken": depth is not None and one.topic == depth.topic,
            }
            for one in overview.candidates
        }
    if depth and depth.frame_hashes is not None:
        document["frame_hashes"] = list(depth.frame_hashes)
    return document


def _statistics(depth: DepthOverview | None) -> dict[str, Any]:
    found = depth.statistics if depth else None
    names = ("depth_m", "measured_share", "identical_frames", "stamp_steps_back", "undecodable")
    return {
        **{name: getattr(found, name, None) for name in names},
        "coloured_frames": depth.coloured if depth else 0,
        "warnings": _warnings(depth) if depth else [],
    }


def _warnings(depth: DepthOverview) -> list[str]:
    found = depth.statistics.warnings(depth.size, depth.intrinsics)
    if depth.colour_topic and depth.frames and not depth.coloured:
        found.append(
            f"no frame comes with colour: {depth.colour_topic} has no image that can be read within 20 ms of "
            "one; if its stamps are of another clock, colour has to be recorded anew"
        )
    return found


def _depth_lines(overview: Overview) -> list[str]:
    depth = overview.depth
    if depth is None:
        return [*_candidate_lines(overview), f"depth   {_why_none(overview)}"]
    size = f"{depth.size[0]}x{depth.size[1]}"
    return [
        *_candidate_lines(overview),
        f"depth   {depth.topic}: {depth.frames} frames of {size}, {_pace(depth.pace)}",
        f"        {_depths(depth)}",
        f"camera  {_camera(depth)}",
        f"colour  {_colour(depth)}",
        *_gap_lines(depth.pace),
    ]


def _why_none(overview: Overview) -> str:
    """Why no depth topic is taken, and what to do."""
    if overview.candidates:
        return "undecided"
    if not any(topic.messages for topic in overview.topics):
        return "none: there is no message"
    return (
        "none: no topic holds 16-bit or float images, compressedDepth or point clouds; one colour image: "
        "voxscene parse --colour only"
    )


def _candidate_lines(overview: Overview) -> list[str]:
    """Several depth topics, one a line, and which of them the commands take."""
    if not overview.candidates:
        return []
    taken = overview.depth.topic if overview.depth else None
    lines = [f"{len(overview.candidates)} depth topic{'s' * (len(overview.candidates) != 1)}:"]
    lines += [_candidate(one, taken=one.topic == taken) for one in overview.candidates]
    if taken is None:
        return [*lines, "slam, learn and parse take none of them by themselves: choose with --depth-topic"]
    return [*lines, f"slam, learn and parse take {taken}; another with --depth-topic"]


def _candidate(one: DepthCandidate, *, taken: bool) -> str:
    camera = _numbers(one.intrinsics) if one.intrinsics else "camera unknown"
    aligned = ", resampled into a colour camera's view" if one.aligned else ""
    mark = "*" if taken else " "
    return (
        f"  {mark} {one.topic}: {one.size[0]}x{one.size[1]}, {camera}, frame {one.frame_id or '?'}{aligned}"
    )


def _colour(depth: DepthOverview) -> str:
    if depth.colour_topic is None:
        found = "none that is registered to the depth, or whose calibration and mounting are recorded"
        return found + depth.colour_problem
    how = ", of another camera, projected onto the depth" if depth.colour_is_projected else ""
    few = f", with {depth.coloured} of {depth.frames} frames" if depth.coloured < depth.frames else ""
    return f"{depth.colour_topic}{how}{few}"


def _depths(depth: DepthOverview) -> str:
    found = depth.statistics
    if found.depth_m is None:
        return "nothing measured"
    low, middle, high = found.depth_m
    repeated = f", {found.identical_frames} frames repeat the one before" if found.identical_frames else ""
    return f"{low:.3g} to {high:.3g} m, median {middle:.3g} m, {found.measured_share:.0%} measured{repeated}"


def _camera(depth: DepthOverview) -> str:
    if depth.intrinsics is None:
        return depth.camera_problem or "unknown"
    return f"{_numbers(depth.intrinsics)}  ({depth.camera_topic or 'given or derived'})"


def _numbers(camera: CameraIntrinsics) -> str:
    return f"fx {camera.fx:.3f}  fy {camera.fy:.3f}  cx {camera.cx:.3f}  cy {camera.cy:.3f}"


def _pace(pace: Pace) -> str:
    rate = "" if pace.rate_hz is None else f" at {pace.rate_hz:.3g} Hz"
    return f"{pace.duration_s:.3f} s{rate}"


def _gap_lines(pace: Pace) -> list[str]:
    if not pace.gaps_s:
        return []
    longest = sorted(pace.gaps_s, key=lambda gap: -gap[1])[:_GAPS_SHOWN]
    shown = ", ".join(f"{length:.3g} s at {start:.3f} s" for start, length in longest)
    return [f"gaps    {len(pace.gaps_s)} in the depth frames, the longest {shown}"]


def _attachment_lines(overview: Overview) -> list[str]:
    if not overview.attachments:
        return []
    files = [f"{one.name} ({one.media_type}, {one.data_size} bytes)" for one in overview.attachments]
    return [f"files   {', '.join(files)}"]


def _topic_lines(overview: Overview) -> list[str]:
    rows = [("TOPIC", "MESSAGES", "HZ", "GAPS", "TYPE")]
    for topic in overview.topics:
        rate = "" if topic.pace.rate_hz is None else f"{topic.pace.rate_hz:.3g}"
        kind = f"{topic.schema} ({topic.encoding})"
        rows.append((_printable(topic.name), str(topic.messages), rate, str(len(topic.pace.gaps_s)), kind))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    return [
        f"{name:<{widths[0]}}  {count:>{widths[1]}}  {rate:>{widths[2]}}  {gaps:>{widths[3]}}  {kind}"
        for name, count, rate, gaps, kind in rows
    ]


def _printable(line: str) -> str:
    """A line without characters that move the cursor or change colours, as names in a recording may hold."""
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in line)


def _verdict(overview: Overview) -> str:
    checked = (
        "every byte read passed its checksum" if overview.damage.verified else "not all of it is checked"
    )
    return f"damage  {describe(overview.damage)}; {checked}"
