"""The messages of one channel as lines of text or JSON objects. Shell (a queue)."""

import json
import math
import queue
from collections.abc import Mapping
from typing import Any, Final

from sightline.operator_side.client.pictures import FrameViewer
from sightline.protocol.channels import FRAME, JPEG, REPORT, SCAN, TWIST, Channel
from sightline.protocol.codec import decode, decode_ranges
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.log import printable
from sightline.protocol.messages import DetectionsHeader, MissionReport, WireModel
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import LatestSlot, Link, Message

MAX_WAITING: Final = 64
"""Limit of messages that wait for printing; further ones are dropped and counted."""


class ChannelInbox:
    """Receives the messages of `channel` from its construction on."""

    def __init__(self, link: Link, role: str, channel: Channel, secure: str = "") -> None:
        """Subscribe to the channel.

        Args:
            link: link to the robot.
            role: role of `link`.
            channel: channel whose messages the inbox collects.
            secure: folder of the keys of `link`, or "".
        """
        self._waiting: queue.Queue[Message] = queue.Queue(MAX_WAITING)
        self._picture: LatestSlot[Message] | None = LatestSlot() if channel.encoding == JPEG else None
        self._viewer = FrameViewer(link, role, secure) if channel is FRAME else None
        self.robot, self.channel = link.robot, channel
        self._overflow = 0
        link.subscribe(channel, self._put)

    @property
    def dropped(self) -> int:
        """Return the number of dropped messages."""
        return self._overflow + (self._picture.dropped if self._picture else 0)

    def take(self, timeout_s: float) -> Message | None:
        """Take the next message in order; on an image channel only the newest.

        Args:
            timeout_s: longest wait, s.

        Returns:
            The message, or None if no message arrived in time.
        """
        message = self._picture.take(timeout_s) if self._picture else self._next_text(timeout_s)
        if message is not None and self._viewer is not None:
            self._viewer.acknowledge(message)
        return message

    def _next_text(self, timeout_s: float) -> Message | None:
        try:
            return self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def _put(self, message: Message) -> None:
        if self._picture is not None:
            self._picture.put(message)
            return
        try:
            self._waiting.put_nowait(message)
        except queue.Full:
            self._overflow += 1


# --- any message as one line, or as a JSON object for a script ---------------------------------------------------


_LEFT_OUT: Final = ("v",)
_EMPTY: Final[tuple[Any, ...]] = (None, "", {}, [], ())


def message_object(message: Message) -> dict[str, Any]:
    """Return the decoded header and payload in JSON types. `error` describes an invalid message."""
    read: dict[str, Any] = {"channel": message.channel.name}
    if message.source:
        read["source"] = message.source
    try:
        return {**read, "header": _header(message), "payload": _payload(message)}
    except WireError as error:
        return {**read, "error": str(error), "header_bytes": len(message.header), "payload_bytes": len(message.payload)}


def message_line(message: Message) -> str:
    """Format a message as one line. For images and scans it contains only the size."""
    read = message_object(message)
    name = message.channel.name + (f"/{message.source}" if message.source else "")
    if "error" in read:
        return f"{name}: invalid: {read['error']}"
    header, payload = read["header"] or {}, read["payload"]
    number = f" #{header['seq']}" if "seq" in header else " (no header)"
    rest = _words({key: value for key, value in header.items() if key not in ("seq", *_LEFT_OUT)})
    return f"{name}{number}: {_payload_text(message.channel, payload)}" + (f"   [{rest}]" if rest else "")


def _header(message: Message) -> dict[str, Any] | None:
    if not message.header:
        return None
    return _plain(decode(message.channel.header, message.header))


def _payload(message: Message) -> Any:
    channel, payload = message.channel, message.payload
    if channel.payload is not None:
        return _plain(decode(channel.payload, payload, channel.max_payload_bytes))
    if channel.encoding == JPEG:
        size = read_jpeg_size(payload)
        return {"width_px": size.width_px, "height_px": size.height_px, "bytes": len(payload)}
    if channel is TWIST:
        return _plain(parse_twist(payload))
    if channel is SCAN:
        return {"ranges_m": [None if math.isinf(one) else round(one, 4) for one in decode_ranges(payload)]}
    return None


def _plain(model: WireModel) -> dict[str, Any]:
    return model.model_dump(mode="json")


def _payload_text(channel: Channel, payload: Any) -> str:
    if payload is None:
        return "-"
    if channel.encoding == JPEG:
        return f"{payload['width_px']}x{payload['height_px']} JPEG, {payload['bytes']} bytes"
    if channel is TWIST:
        return f"{payload['linear_mps']:+.4f} m/s {payload['angular_rad_s']:+.4f} rad/s"
    if channel is SCAN:
        return _scan_text(payload["ranges_m"])
    return _words(payload)


def _scan_text(ranges_m: list[float | None]) -> str:
    seen = [one for one in ranges_m if one is not None]
    nearest = f"nearest {min(seen):.2f} m" if seen else "nothing near"
    return f"{len(ranges_m)} rays, {len(seen)} detect something, {nearest}"


def _words(values: Mapping[str, Any]) -> str:
    """Format as `name=value`, without empty values."""
    return " ".join(f"{printable(name)}={_word(value)}" for name, value in values.items()
                    if name not in _LEFT_OUT and value not in _EMPTY)


def _word(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + _words(value) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_word(one) for one in value) + "]"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.1f}"
    if isinstance(value, str):
        return value if value.isprintable() and value and " " not in value else json.dumps(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


# --- the target of a report --------------------------------------------------------------------------------------


TARGET_COLUMNS: Final = (
    "robot", "t_us", "phase", "label", "score", "track", "bearing_rad", "distance_m", "cx_px", "cy_px", "radius_px",
    "width_px", "height_px", "detector",
)


def target_object(message: Message) -> dict[str, Any]:
    """Return the target of a report in `TARGET_COLUMNS`, None for missing values. `phase` describes an invalid report.

    `t_us` is the capture time of its image, on the robot's clock.
    """
    try:
        header = decode(DetectionsHeader, message.header)
        report = decode(MissionReport, message.payload, REPORT.max_payload_bytes)
    except WireError as error:
        return dict.fromkeys(TARGET_COLUMNS) | {"phase": f"invalid report: {error}"}
    target = _plain(report.target) if report.target else {}
    return dict.fromkeys(TARGET_COLUMNS) | {
        "t_us": header.echo.t_us if header.echo else None, "phase": report.phase, "detector": report.detector, **target,
    }


def target_line(target: Mapping[str, Any]) -> str:
    """Format a target as one line."""
    if target["label"] is None:
        return f"no target ({printable(target['phase'])})"
    bearing = "" if target["bearing_rad"] is None else f"{math.degrees(target['bearing_rad']):+6.1f} deg  "
    distance = "" if target["distance_m"] is None else f"{target['distance_m']:5.2f} m  "
    radius = "" if target["radius_px"] is None else f", radius {target['radius_px']:.1f}"
    place = f"{target['cx_px']:.0f},{target['cy_px']:.0f} px"
    size = f"{target['width_px']}x{target['height_px']}"
    return printable(f"{bearing}{distance}{target['label']} {target['score']:.2f} at {place}{radius} of {size} "
                     f"({target['phase']})")
