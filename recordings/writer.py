"""Writing recordings that every MCAP tool shows as they are: ROS 2 images, camera and transforms."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Literal

import numpy as np
from mcap.reader import make_reader
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from recordings.errors import RecordingError
from recordings.messages import ros2_standard as ros2
from recordings.types import NO_RETURN, CameraIntrinsics, Frame

CAMERA_FRAME = "camera_depth_optical_frame"
WORLD_FRAME = "world"
DEPTH_TOPIC = "/camera/depth/image_rect_raw"
CAMERA_TOPIC = "/camera/depth/camera_info"
COLOUR_TOPIC = "/camera/color/image_rect_raw"
COLOUR_CAMERA_TOPIC = "/camera/color/camera_info"
POSE_TOPIC = "/tf"

Profile = Literal["", "ros2"]
"""What MCAP's registry knows (https://mcap.dev/spec/registry): `ros2` promises CDR and ROS 2 definitions on
every topic, which some readers of ROS insist on; the empty profile promises nothing."""
_CHANNEL_METADATA: Mapping[Profile, dict[str, str]] = {"": {}, "ros2": {"offered_qos_profiles": ""}}
"""Which the profile requires; empty where no middleware was there to offer any."""
_CHUNK_SIZE = 1 << 20
_MILLIMETRE = 0.001
_LIBRARY = "voxscene"
"""In the header of every file that is written here."""
_LARGEST_MILLIMETRES = 65534  # 65535 reads as saturated


@dataclass(frozen=True, kw_only=True)
class MessageSchema:
    """How the messages of a topic are to be read, as MCAP names it (https://mcap.dev/spec/registry)."""

    name: str
    encoding: str
    data: bytes
    message_encoding: str


class RecordingWriter:
    """Writes one MCAP file: zstd chunks of 1 MiB, every byte under a checksum, whole or not at all.

    The file gets its name only when the `with` block ends without an error; until then, and after a
    kill, it is `NAME.partial`, which only one process at a time may write.

    Args:
        path: the file to write; a recording that was written here before is replaced.
        intrinsics: the camera of the depth frames, where any are written.
        depth_unit_m: unit of the source's depths. 0.001 writes 16-bit millimetres, anything else
            32-bit metres, so that nothing is lost.
        profile: of the file; `ros2` where nothing but ROS 2 messages will be written.
        mends: replace what is no readable recording, too: for a place that is the program's own.

    Raises:
        RecordingError: the file cannot be written, now or later.
    """

    def __init__(
        self,
        path: Path,
        intrinsics: CameraIntrinsics | None = None,
        *,
        depth_unit_m: float | None = None,
        profile: Profile = "",
        mends: bool = False,
    ) -> None:
        self._path = Path(path)
        self._profile: Profile = profile
        self._partial = self._path.with_name(self._path.name + ".partial")
        self._intrinsics = intrinsics
        self._millimetres = depth_unit_m == _MILLIMETRE
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[MessageSchema, int] = {}
        self._sequences: Counter[str] = Counter()
        if self._path.exists() and not self._path.is_file():
            raise RecordingError(f"cannot write {self._path}: it exists and is not a file")
        if _is_of_others(self._path, unreadable=not mends):
            raise RecordingError(
                f"cannot write {self._path}: it is a recording or a file by another program, name another one"
            )
        with self._reporting():
            self._file: BinaryIO = _opened_alone(self._partial)
            self._writer = Writer(
                self._file, chunk_size=_CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True
            )
            self._writer.start(profile=profile, library=_LIBRARY)

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._discard()
            return
        with self._reporting():
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._partial.replace(self._path)
            self._file.close()
            _sync_folder(self._path.parent)

    def write_depth(self, frame: Frame) -> None:
        """Write a frame with its camera: depth, and colour where it has any.

        Raises:
            ValueError: the writer was made without intrinsics, or the frame has another size.
        """
        if self._intrinsics is None:
            raise ValueError("a writer of depth frames needs intrinsics")
        if frame.depth_m.shape != (self._intrinsics.height, self._intrinsics.width):
            raise ValueError(f"a frame of shape {frame.depth_m.shape} was not taken by {self._intrinsics}")
        time_ns = frame.time_ns
        camera = ros2.camera_info(time_ns, CAMERA_FRAME, self._intrinsics)
        encoding, pixels = self._stored_depth(frame.depth_m)
        self._write_ros2(CAMERA_TOPIC, camera, time_ns)
        self._write_ros2(DEPTH_TOPIC, ros2.image(time_ns, CAMERA_FRAME, encoding, pixels), time_ns)
        if frame.rgb is not None:
            self._write_ros2(COLOUR_CAMERA_TOPIC, camera, time_ns)
            self._write_ros2(COLOUR_TOPIC, ros2.image(time_ns, CAMERA_FRAME, "rgb8", frame.rgb), time_ns)

    def write_camera_pose(self, time_ns: int, world_from_camera: NDArray[np.floating]) -> None:
        """Write where the depth camera was (4, 4), as a transform on /tf."""
        message = ros2.transform(time_ns, WORLD_FRAME, CAMERA_FRAME, world_from_camera)
        self._write_ros2(POSE_TOPIC, message, time_ns)

    def write(self, topic: str, schema: MessageSchema, data: bytes, time_ns: int) -> None:
        """Write one encoded message; its log time is the recording's time, never a clock's.

        Raises:
            ValueError: the file's profile does not allow it.
        """
        if self._profile == "ros2" and schema.message_encoding != MessageEncoding.CDR:
            raise ValueError(f"{topic} is {schema.message_encoding}, which the profile ros2 does not allow")
        with self._reporting():
            channel = topic, schema.name
            if channel not in self._channels:
                metadata = _CHANNEL_METADATA[self._profile]
                self._channels[channel] = self._writer.register_channel(
                    topic, schema.message_encoding, self._schema_id(schema), metadata
                )
            self._writer.add_message(
                self._channels[channel], time_ns, data, time_ns, sequence=self._sequences[topic]
            )
            self._sequences[topic] += 1

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        with self._reporting():
            self._writer.add_metadata(name, dict(values))

    def write_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Write a file that stands beside the messages."""
        with self._reporting():
            self._writer.add_attachment(time_ns, time_ns, name, media_type, data)

    def _write_ros2(self, topic: str, message: object, time_ns: int) -> None:
        name, data = ros2.encode(message)
        schema = MessageSchema(
            name=name,
            encoding=SchemaEncoding.ROS2,
            data=ros2.standard_definition(name).encode(),
            message_encoding=MessageEncoding.CDR,
        )
        self.write(topic, schema, data, time_ns)

    def _schema_id(self, schema: MessageSchema) -> int:
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._schemas[schema]

    def _stored_depth(self, depth_m: NDArray[np.float32]) -> tuple[str, NDArray]:
        if self._millimetres:
            millimetres = np.rint(depth_m * np.float32(1000))
            millimetres[millimetres > _LARGEST_MILLIMETRES] = 0
            return "16UC1", millimetres.astype("<u2")
        return "32FC1", np.where(depth_m == NO_RETURN, np.float32(np.nan), depth_m).astype("<f4")

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        """Nothing half-written stays behind a full disk or a folder that is not there."""
        try:
            yield
        except OSError as error:
            self._discard()
            raise RecordingError(f"cannot write {self._path}: {error.strerror or error}") from error

    def _discard(self) -> None:
        file = getattr(self, "_file", None)
        if file is not None:
            self._partial.unlink(missing_ok=True)
            with suppress(OSError):  # the rest of the buffer does not fit on a full disk either
                file.close()


def _is_of_others(path: Path, *, unreadable: bool) -> bool:
    """Whether a file holds anything but a recording that was written here; `unreadable` for what is none."""
    if not path.is_file() or not path.stat().st_size:
        return False
    with path.open("rb") as file:
        try:
            return make_reader(file).get_header().library != _LIBRARY
        except Exception:  # what the mcap library raises on other files and on damage
            return unreadable


def _opened_alone(path: Path) -> BinaryIO:
    """An empty file to write, that no other process writes; the system lets go when the process ends.

    Raises:
        RecordingError: another process writes it.
    """
    try:
        import fcntl
    except ImportError:  # not on Windows, where an open file cannot be renamed over
        return path.open("wb")
    while True:
        file = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT, 0o666), "wb")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.close()
            raise RecordingError(f"{path} is being written by another process; wait for it") from error
        with suppress(FileNotFoundError):  # who held it may have renamed it in between
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                file.truncate(0)
                return file
        file.close()


def _sync_folder(folder: Path) -> None:
    """Make the new name survive a power cut, where the system can."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
