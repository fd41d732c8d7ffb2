"""What a recording holds, read from end to end: topics, rates, gaps, depth, damage."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from recordings.colour_topics import unread_images
from recordings.depth_statistics import DepthStatistics
from recordings.depth_topics import DepthTopic, choose_depth_topic, depth_topics, is_aligned_to_colour
from recordings.errors import RecordingError
from recordings.mcap_files.attachments import Attachment
from recordings.mcap_files.bag import Bag
from recordings.messages.decoded_bag import DecodedBag
from recordings.options import ReadOptions
from recordings.reading import McapRecording
from recordings.types import CameraIntrinsics, Damage

_SECOND_NS = 1_000_000_000
_GAP_FACTOR = 2.5
"""An interval longer than this many usual ones is a gap."""


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How regularly messages come.

    Attributes:
        duration_s: from the first to the last.
        rate_hz: 1 / median interval; None for fewer than two.
        gaps_s: (start, length) of each interval much longer than usual, in seconds after the first.
    """

    duration_s: float
    rate_hz: float | None
    gaps_s: tuple[tuple[float, float], ...]


@dataclass(frozen=True, kw_only=True)
class TopicOverview:
    """One topic: how many messages of what type, and their pace by log time."""

    name: str
    schema: str
    encoding: str
    messages: int
    pace: Pace


@dataclass(frozen=True, kw_only=True)
class DepthOverview:
    """The depth frames: pace by their stamps, sha256 of each frame's metres where asked for.

    `coloured` frames came with colour.
    """

    topic: str
    frames: int
    coloured: int
    size: tuple[int, int]
    pace: Pace
    intrinsics: CameraIntrinsics | None
    camera_topic: str | None
    camera_problem: str | None
    colour_topic: str | None
    colour_is_projected: bool
    colour_problem: str
    frame_hashes: tuple[str, ...] | None
    statistics: DepthStatistics


@dataclass(frozen=True, kw_only=True)
class DepthCandidate:
    """One of several depth topics.

    Attributes:
        topic: its name.
        size: width and height of its images.
        intrinsics: of its camera, where that is known.
        frame_id: the frame that its images say they were taken in.
        aligned: whether that is the frame of a colour camera, so that the images are resampled.
    """

    topic: str
    size: tuple[int, int]
    intrinsics: CameraIntrinsics | None
    frame_id: str
    aligned: bool


@dataclass(frozen=True, kw_only=True)
class Overview:
    """A recording at a glance; `problems` are sentences for a person.

    `depth` is of the topic that every command takes: None where there is none, or where the user has to
    choose among the `candidates`. Those are told where there are several, without those that cannot be used.
    """

    topics: tuple[TopicOverview, ...]
    attachments: tuple[Attachment, ...]
    depth: DepthOverview | None
    candidates: tuple[DepthCandidate, ...]
    damage: Damage
    problems: tuple[str, ...]


def survey(path: Path, options: ReadOptions, *, hashes: bool = False) -> Overview:
    """Read a recording from end to end.

    Raises:
        RecordingError: it cannot be read, or the depth topic that the options name holds no depth.
    """
    bag = Bag(Path(path))
    topics = _survey_topics(bag)
    decoded = DecodedBag(bag)
    names = depth_topics(decoded)
    topic = _taken(decoded, options, len(names))
    recording = None if topic is None else McapRecording(decoded, topic, options)
    if recording is not None:
        depth = _survey_depth(recording, hashes=hashes)
        damage, problems = recording.damage, recording.problems
    else:
        lost, unread = decoded.undecodable_topics(), unread_images(decoded)
        depth, problems = None, [*bag.problems, *lost, *([unread] if unread and not names else [])]
        damage = replace(bag.damage, lost_messages=bag.damage.lost_messages + sum(lost.values()))
    candidates, unusable = _candidates(decoded, names, options)
    return Overview(
        topics=topics,
        attachments=tuple(bag.attachments),
        depth=depth,
        candidates=candidates,
        damage=damage,
        problems=(*problems, *unusable),
    )


def _taken(decoded: DecodedBag, options: ReadOptions, count: int) -> DepthTopic | None:
    """The topic that commands take; None where there is none or the user has to choose."""
    try:
        return choose_depth_topic(decoded, options.depth_topic, options.start_s)
    except RecordingError:
        if options.depth_topic is not None or count < 2:
            raise
        return None


def _candidates(
    decoded: DecodedBag, names: list[str], options: ReadOptions
) -> tuple[tuple[DepthCandidate, ...], list[str]]:
    """The depth topics, where there are several; and a sentence on each that cannot be used.

    A mask and a sensor profile are of the topic that is taken: they say nothing of the others.
    """
    found: list[DepthCandidate] = []
    problems: list[str] = []
    for name in names if len(names) > 1 else ():
        try:
            found.append(_candidate(decoded, name, replace(options, mask=None, sensor=None)))
        except RecordingError as error:
            problems.append(str(error))
    return tuple(found), problems


def _candidate(decoded: DecodedBag, name: str, options: ReadOptions) -> DepthCandidate:
    topic = choose_depth_topic(decoded, name, options.start_s)
    assert topic is not None
    recording = McapRecording(decoded, topic, options)
    return DepthCandidate(
        topic=name,
        size=recording.size,
        intrinsics=None if recording.camera_problem else recording.intrinsics,
        frame_id=recording.frame_id,
        aligned=is_aligned_to_colour(decoded, name),
    )


def _survey_topics(bag: Bag) -> tuple[TopicOverview, ...]:
    times: dict[str, list[int]] = {topic.name: [] for topic in bag.topics}
    for topic, log_time_ns, _ in bag.messages():
        times[topic.name].append(log_time_ns)
    kinds = {topic.name: topic for topic in bag.topics}
    return tuple(
        TopicOverview(
            name=name,
            schema=kinds[name].schema_name,
            encoding=kinds[name].message_encoding,
            messages=len(stamps),
            pace=_pace(sorted(stamps)),
        )
        for name, stamps in times.items()
    )


def _survey_depth(recording: McapRecording, *, hashes: bool) -> DepthOverview:
    stamps: list[int] = []
    found: list[str] = []
    coloured = 0
    for frame in recording:
        stamps.append(frame.time_ns)
        coloured += frame.rgb is not None
        if hashes:
            found.append(hashlib.sha256(frame.depth_m.tobytes()).hexdigest())
    statistics = recording.statistics()
    statistics.undecodable = recording.undecodable
    return DepthOverview(
        topic=recording.depth_topic,
        frames=len(stamps),
        coloured=coloured,
        size=recording.size,
        pace=_pace(stamps),
        intrinsics=None if recording.camera_problem else recording.intrinsics,
        camera_topic=recording.camera_topic,
        camera_problem=recording.camera_problem,
        colour_topic=recording.colour_topic,
        colour_is_projected=recording.colour_is_projected,
        colour_problem=recording.colour_problem,
        frame_hashes=tuple(found) if hashes else None,
        statistics=statistics,
    )


def _pace(times_ns: list[int]) -> Pace:
    if len(times_ns) < 2:
        return Pace(duration_s=0.0, rate_hz=None, gaps_s=())
    # A damaged log time may be any number of 64 bits, so that differences need not fit into one.
    times = np.array([time_ns - times_ns[0] for time_ns in times_ns], np.float64)
    intervals = np.diff(times)
    usual = float(np.median(intervals))
    long = np.flatnonzero(intervals > _GAP_FACTOR * usual) if usual > 0 else []
    return Pace(
        duration_s=float(times[-1] - times[0]) / _SECOND_NS,
        rate_hz=_SECOND_NS / usual if usual > 0 else None,
        gaps_s=tuple(
            (float(times[i] - times[0]) / _SECOND_NS, float(intervals[i]) / _SECOND_NS) for i in long
        ),
    )
