"""Writes the messages of a link to MCAP and reads them back. Shell (threads, files).

One MCAP channel per Sightline channel (and source: `twist/vision`), as JSON with a schema, which other tools show
(`foxglove`). A message that is not valid JSON, and every message of older recordings, has the encoding `sightline.v1`:
header length (uint16, big-endian), header, payload. Both read back exactly as the message came. `log_time` is when this
end received it, for the robot's own clock is in the header. It never goes back: the wall clock is read once. A file cut
short by a kill reads here up to the cut; for other tools, `mcap recover` writes its index.
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
"""The most messages that wait for the disk; further ones are dropped and counted."""
CLOSE_S: Final = 5.0
"""For the disk to take what waits when the recording is closed."""
CHUNK_BYTES: Final = 256 * 1024  # a kill loses at most one chunk
_LENGTH = struct.Struct(">H")

_log: Final = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Recorded:
    """A message and its time of arrival (Unix time)."""

    log_time_ns: int
    message: Message


class Recorder:
    """Records `link` from construction to `close`. Its callbacks only queue; a thread writes."""

    def __init__(
        self, link: Link, path: Path, about: Mapping[str, str], channels: Iterable[Channel] = RECORDED
    ) -> None:
        """Open the file and store `about` in it as metadata. Raises ConfigError for a path that cannot be written."""
        self._queue: queue.Queue[tuple[int, Message] | None] = queue.Queue(MAX_WAITING)
        self._path, self._file = path, _open_new(path)
        self._writer, self._about = _writer(self._file), dict(about)
        self._ids: dict[tuple[str, str], int] = {}
        self._counts: dict[str, int] = {}
        self.dropped = 0
        """Number of messages that the disk was too slow for."""
        self.failed = ""
        """The error that ended the recording, or ""."""
        self._since_ns = time.time_ns() - time.monotonic_ns()  # once: MCAP tools sort by time, and the wall clock steps
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
        """Turn a failed write into one log line and the end of the recording."""
        try:
            yield
        except Exception as error:  # the library's own too: whatever it is, `close` must not wait for it
            cause = getattr(error, "strerror", None)  # of the disk; any other is a defect
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
        """Write the waiting messages and finish the file, for `CLOSE_S` at most; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._ended.set()
        with suppress(queue.Full):  # then the thread has something to wake for
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
    """A file without a buffer: where the disk hangs, Python waits at its exit for the lock of a buffered file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self.tell, self.flush, self.close = self._file.tell, self._file.flush, self._file.close

    def write(self, data: bytes) -> None:
        """Write all of `data`. Raises OSError where the disk takes only a part."""
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
    # JPEG does not compress; the rest is not worth the time on the machine that drives.
    return Writer(cast(Any, file), chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)


def read_recording(path: Path) -> Iterator[Recorded]:
    """Yield every message in the order of arrival, to the end of the file. Raises ConfigError for another file."""
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
    except (EndOfFile, struct.error, UnicodeDecodeError):  # the cut is inside a number or a letter
        return
    except OSError as error:
        raise ConfigError(f"cannot read recording {path}: {error.strerror}") from None
    except (McapError, ValueError, OverflowError, MemoryError) as error:  # a damaged length may be of any size
        raise ConfigError(f"invalid recording {path}: {type(error).__name__}") from None


def _parse(topic: str, encoding: str, data: bytes) -> Message | None:
    name, _, source = topic.partition("/")
    channel = CHANNELS.get(name)
    if channel is not None and encoding == foxglove.ENCODING:
        return foxglove.received(channel, source, data)
    if channel is None or len(data) < _LENGTH.size:
        return None
    end = _LENGTH.size + _LENGTH.unpack_from(data)[0]
    return Message(channel, source, data[_LENGTH.size : end], data[end:])
