"""Writes the messages of a link to MCAP and reads them back. Shell (threads, files).

Each Sightline channel (with its source: `twist/vision`) is one MCAP channel of JSON messages with a schema, which other
tools show (`foxglove`). Invalid messages, and all messages of older recordings, have the encoding `sightline.v1`:
header length (uint16, big-endian), header and payload. Both are read back exactly as received. `log_time` is the time
of arrival; the header has the robot's time. It never goes back, because the wall clock is read once. A file that a kill
truncated is readable here up to the cut; for other tools, `mcap recover` writes its index.
"""

import errno
import logging
import os
import queue
import struct
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self, cast

from sightline.operator_side.preflight import needs
from sightline.operator_side.recording import foxglove
from sightline.protocol.channels import (
    ACK,
    CAMERA,
    CHANNELS,
    DETECTIONS,
    FRAME,
    MISSION,
    REPORT,
    SCAN,
    STATUS,
    TWIST,
    Channel,
)
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import report_fault
from sightline.protocol.transports.link import Link, Message

if TYPE_CHECKING:
    from mcap.writer import Writer

ENCODING: Final = "sightline.v1"
METADATA: Final = "sightline"
RECORDED: Final = (FRAME, TWIST, ACK, STATUS, CAMERA, SCAN, MISSION, REPORT, DETECTIONS)
MAX_WAITING: Final = 256
"""Limit of messages that wait for the disk; further ones are dropped and counted."""
CLOSE_S: Final = 5.0
"""Time for the disk to write the waiting messages at the end of the recording."""
CHUNK_BYTES: Final = 256 * 1024  # a kill loses at most one chunk
_LENGTH = struct.Struct(">H")

_log: Final = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Recorded:
    """A message and its time of arrival (Unix time)."""

    log_time_ns: int
    message: Message


class Recorder:
    """Records `link` from construction to `close`. Its callbacks only queue messages; a thread writes them."""

    def __init__(
        self, link: Link, path: Path, about: Mapping[str, str], channels: Iterable[Channel] = RECORDED
    ) -> None:
        """Open the file and store `about` in it as metadata. Raises ConfigError for a path that cannot be written."""
        self._queue: queue.Queue[tuple[int, Message] | None] = queue.Queue(MAX_WAITING)
        self._path, self._file = path, _open_new(path)
        self._writer, self._about = _writer(self._file), dict(about)
        self._ids: dict[tuple[str, str], int] = {}
        self._counts: dict[str, int] = {}
        self._span_ns: tuple[int, int] | None = None  # first and last message
        self.dropped = 0
        """Number of messages dropped because the disk was too slow."""
        self.failed = ""
        """The error that ended the recording, or ""."""
        self._since_ns = time.time_ns() - time.monotonic_ns()  # read once, because the wall clock may jump
        self._closed = False
        self._ended = threading.Event()
        self._writing = threading.Thread(target=self._write_all, name="recorder", daemon=True)
        self._writing.start()
        for channel in channels:
            link.subscribe(channel, self._take)

    @property
    def counts(self) -> dict[str, int]:
        """Return the number of written messages of each topic."""
        return dict(self._counts)

    @property
    def seconds(self) -> float:
        """Return the time from the first written message to the last."""
        first_ns, last_ns = self._span_ns or (0, 0)
        return (last_ns - first_ns) / 1e9

    def _take(self, message: Message) -> None:
        if self._closed or self.failed:
            return
        try:
            self._queue.put_nowait((self._since_ns + time.monotonic_ns(), message))
        except queue.Full:
            self.dropped += 1

    def _write_all(self) -> None:
        with self._reporting():
            self._writer.start(profile="", library="sightline")
            self._writer.add_metadata(METADATA, self._about)
            while not (self._ended.is_set() and self._queue.empty()) and (item := self._queue.get()):
                self._write(*item)
            self._writer.finish()  # type: ignore[no-untyped-call]
        with self._reporting():
            self._file.close()

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        """Convert a failed write to one log line, and end the recording."""
        try:
            yield
        except Exception as error:  # also errors of the library, because `close` must not wait for this thread
            cause = getattr(error, "strerror", None)  # only for errors of the disk; others are defects
            self._fail(cause or f"{type(error).__name__}: {report_fault('recorder', error)}")

    def _fail(self, why: str) -> None:
        if not self.failed:
            self.failed = why
            _log.warning("recording %s: %s; the recording ends", self._path, why)

    def _write(self, log_time_ns: int, message: Message) -> None:
        topic = message.channel.name + (f"/{message.source}" if message.source else "")
        count = self._counts[topic] = self._counts.get(topic, 0) + 1
        try:
            encoding, data = foxglove.ENCODING, foxglove.shown(message, log_time_ns)
        except ValueError:
            encoding, data = ENCODING, _LENGTH.pack(len(message.header)) + message.header + message.payload
        number = self._channel_id(topic, encoding, message.channel)
        self._writer.add_message(number, log_time_ns, data, log_time_ns, count)
        self._span_ns = (self._span_ns or (log_time_ns, 0))[0], log_time_ns
        pose = foxglove.transform(message, log_time_ns)
        if pose is not None:
            number = self._channel_id(foxglove.TRANSFORM, foxglove.ENCODING, None)
            self._writer.add_message(number, log_time_ns, pose, log_time_ns)

    def _channel_id(self, topic: str, encoding: str, channel: Channel | None) -> int:
        """Return the number of a topic in the file. JSON has the schema of `channel`, or of the transforms for None."""
        if (topic, encoding) not in self._ids:
            schema_id = 0
            if encoding == foxglove.ENCODING:
                name, schema = foxglove.schema_of(channel)
                schema_id = self._writer.register_schema(name, foxglove.SCHEMA_ENCODING, schema)
            self._ids[topic, encoding] = self._writer.register_channel(topic, encoding, schema_id)
        return self._ids[topic, encoding]

    def close(self) -> None:
        """Write the waiting messages and finish the file, for `CLOSE_S` at most. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._ended.set()
        with suppress(queue.Full):  # a full queue wakes the thread as well
            self._queue.put_nowait(None)
        self._writing.join(CLOSE_S)
        if self._writing.is_alive():
            self._fail(f"the disk does not respond for {CLOSE_S:g} s")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class RecordingFile:
    """An unbuffered file. If the disk hangs, Python would wait at exit for the lock of a buffered file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self.tell, self.flush, self.close = self._file.tell, self._file.flush, self._file.close

    def write(self, data: bytes) -> None:
        """Write all of `data`. Raises OSError if the disk accepts only a part."""
        if self._file.write(data) < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _open_new(path: Path) -> RecordingFile:
    try:
        return RecordingFile(path)
    except OSError as error:
        raise ConfigError(f"recording {path}: {error.strerror}; choose a folder that you may write") from None


def _writer(file: RecordingFile) -> "Writer":
    with needs("report"):
        from mcap.writer import CompressionType, Writer
    # JPEG data does not compress further, and the other data is not worth the CPU time of the driving machine.
    return Writer(cast(Any, file), chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)


def read_recording(path: Path) -> Iterator[Recorded]:
    """Yield every message in the order of arrival, to the end of the file. Raises ConfigError for another file type."""
    with _reading(path) as reader:
        for _schema, channel, message in reader.iter_messages(log_time_order=False):
            parsed = _parse(channel.topic, channel.message_encoding, message.data)
            if parsed is not None:
                yield Recorded(message.log_time, parsed)


def read_about(path: Path) -> dict[str, str]:
    """Return the metadata of the recorder. Raises ConfigError if the file is not a recording of Sightline."""
    with _reading(path) as reader:
        for record in reader.iter_metadata():
            if record.name == METADATA:
                return dict(record.metadata)
    raise ConfigError(f"{path} is not a recording of Sightline; choose a run.mcap")


@contextmanager
def _reading(path: Path) -> Iterator[Any]:
    """Open an MCAP reader; a truncated file ends early."""
    with needs("report"):
        from mcap.exceptions import EndOfFile, McapError
        from mcap.reader import NonSeekingReader
    try:
        with path.open("rb") as file:
            yield NonSeekingReader(file)
    except (EndOfFile, struct.error, UnicodeDecodeError):  # the cut is inside a number or a character
        return
    except OSError as error:
        raise ConfigError(f"cannot read recording {path}: {error.strerror}") from None
    except (McapError, ValueError, OverflowError, MemoryError) as error:  # a damaged length may have any value
        why = f"damaged, or another type of file ({type(error).__name__})"
        raise ConfigError(f"invalid recording {path}: {why}; choose a run.mcap") from None


def _parse(topic: str, encoding: str, data: bytes) -> Message | None:
    name, _, source = topic.partition("/")
    channel = CHANNELS.get(name)
    if channel is not None and encoding == foxglove.ENCODING:
        return foxglove.received(channel, source, data)
    if channel is None or len(data) < _LENGTH.size:
        return None
    end = _LENGTH.size + _LENGTH.unpack_from(data)[0]
    return Message(channel, source, data[_LENGTH.size : end], data[end:])
