"""Replaces the gate of a legacy robot: STOP, disarm and arm of operators, status, a camera model. Shell.

    with legacy_link(config) as link:
        serve(config, link, ...)

A legacy robot applies each command forever and validates nothing. Its operators therefore send requests to the vision
service that drives it, and the commands of that service pass through this link.

The robot confirms no command. A zero counts as delivered if an image comes at least 100 ms later on the same
connection. Until then the robot may move: its state is ACTIVE, and STOP and disarm are not confirmed.
"""

from __future__ import annotations

import math
import secrets
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from sightline.protocol.channels import DETECTIONS, FRAME, REPLY, REQUEST, STATUS, TWIST, Channel
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import check_sizes, decode, encode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import (
    LEAST_SIDE_PX,
    MOST_SIDE_PX,
    STILL,
    CameraModel,
    DetectedBox,
    Detections,
    Echo,
    FrameHeader,
    LeaseHolder,
    Reply,
    Request,
    RequestHeader,
    Stamp,
    State,
    Status,
    StreamStatus,
    Verb,
    WireModel,
)
from sightline.protocol.text import format_twist, parse_twist
from sightline.protocol.transports.link import Link, LinkWrapper, Message
from sightline.vision_side.detect.port import Detection

FIELD_OF_VIEW_DEG: Final = 60.0
"""Horizontal field of view of the assumed camera. Most webcams and phone cameras have 55 to 70 degrees."""
STATUS_PERIOD_S: Final = 0.1
_ZERO: Final = format_twist(STILL)
_NO_BOX: Final = encode(Detections(width_px=LEAST_SIDE_PX, height_px=LEAST_SIDE_PX))
_FRESH: Final = round(2.0 / STATUS_PERIOD_S)
"""Number of statuses that a request may cite: those of the last two seconds."""
_IN_FLIGHT_US: Final = 100_000
"""An image that arrives sooner after a zero may be older than the zero, so it shows no delivery."""
_PATIENCE_US: Final = 1_000_000
"""Longest wait for the delivery of a zero before a request fails. Its sender repeats the request."""
_NOT_DELIVERED: Final = "zero is not delivered to the robot; cut its power by hand"
_DRIVING: Final = "legacy robot: it validates no image age, and has no watchdog"


def is_legacy(endpoint: str) -> bool:
    """Return True for the endpoint of a legacy robot."""
    return endpoint.startswith("ws-legacy://")


def assumed_camera(size: JpegSize) -> CameraModel:
    """Return a camera model of 60 degrees for a robot that publishes none.

    Raises:
        WireError: MALFORMED for a size that no camera model can have.
    """
    if not LEAST_SIDE_PX <= min(size.width_px, size.height_px) <= max(size.width_px, size.height_px) <= MOST_SIDE_PX:
        raise WireError(RejectReason.MALFORMED, f"image is {size.width_px}x{size.height_px}, each side must have "
                                                f"{LEAST_SIDE_PX} to {MOST_SIDE_PX} pixels")
    focal_px = round(size.width_px / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG / 2)), 1)
    return CameraModel(width_px=size.width_px, height_px=size.height_px, fx_px=focal_px, fy_px=focal_px,
                       cx_px=size.width_px / 2, cy_px=size.height_px / 2)


def camera_line(camera: CameraModel) -> str:
    """Return the log line that names the assumed camera and the option that sets it."""
    keys = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
    given = ", ".join(f"{key} = {getattr(camera, key):g}" for key in keys)
    return (f"the robot publishes no camera model; assuming {FIELD_OF_VIEW_DEG:g} degrees horizontally; "
            f"set yours with --set 'camera={{{given}}}'")


def target_box(target: Detection | None, camera: CameraModel) -> bytes:
    """Encode the box of the target, or no boxes, for a legacy robot that steers by boxes."""
    boxes = () if target is None else (DetectedBox(
        label=target.label or "target", score=target.score, x1_px=target.x1_px, y1_px=target.y1_px, x2_px=target.x2_px,
        y2_px=target.y2_px),)
    return encode(Detections(width_px=camera.width_px, height_px=camera.height_px, boxes=boxes))


class LegacyRobotLink(LinkWrapper):
    """A link to a legacy robot and its operators. Commands pass only in state ACTIVE; otherwise zero replaces them."""

    def __init__(self, link: Link, now_us: Callable[[], int] = monotonic_us) -> None:
        super().__init__(link)
        self._now_us = now_us
        self._session = secrets.token_hex(4)
        self._holder = LeaseHolder.of("vision", self._session)  # no other program can drive by this link
        self._lock = threading.Lock()
        self._state, self._reason = State.ACTIVE, _DRIVING
        self._applied = (0.0, 0.0)
        self._is_at_rest, self._zero_us = False, 0
        """True if zero is delivered since the last motion, and the time of the first zero after the motion."""
        self._connection = ""
        self._frames_us: list[int] = []  # arrivals of the last second
        self._frames = self._accepted = 0
        self._seqs = {STATUS: 0, REPLY: 0}
        # A request that permits motion cites one of these statuses. STOP and disarm clear them.
        self._issued: deque[Echo] = deque(maxlen=_FRESH)
        self._ending = threading.Event()
        link.subscribe(REQUEST, self._on_request)
        link.subscribe(FRAME, self._on_frame)
        threading.Thread(target=self._report, name="legacy status", daemon=True).start()

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Send a message. A command is sent as zero while the robot may not move."""
        if channel not in (TWIST, DETECTIONS):
            return self._link.publish(channel, header, payload, source)
        # With the lock: a command that was computed before a STOP must not follow the zero of that STOP.
        with self._lock:
            if self._state is not State.ACTIVE:
                payload = _ZERO if channel is TWIST else _NO_BOX
            elif channel is TWIST:
                twist = parse_twist(payload)
                self._applied = (twist.linear_mps, twist.angular_rad_s)
                self._accepted += 1
            return self._link.publish(channel, header, payload, source)

    def close(self) -> None:
        """Close the link."""
        self._ending.set()
        super().close()

    # --- operators ---------------------------------------------------------------------------------------------------

    def _on_request(self, message: Message) -> None:
        try:
            check_sizes(message.channel, message.header, message.payload)
            header, request = decode(RequestHeader, message.header), decode(Request, message.payload)
        except WireError:
            return
        try:
            if header.source != message.source:
                raise WireError(RejectReason.UNKNOWN_SOURCE, "key and header disagree on the source")
            detail, ok = self._carry_out(header, request.verb), True
            if not detail:
                return
        except WireError as error:
            detail, ok = f"{error.reason}: {error.detail}"[:200], False
        reply = Reply(to=header.digest, id=request.id, ok=ok, state=self._shown()[0], detail=detail)
        self._post(REPLY, reply)
        self._post_status()

    def _carry_out(self, header: RequestHeader, verb: Verb) -> str:
        """Return one line for the operator, "" for no reply yet. Raises WireError for a request that is rejected."""
        if verb is Verb.STOP:
            return self._halt(State.STOPPED, f"STOP by {header.source}")
        if verb is Verb.DISARM:
            return self._halt(self._state if self._state is State.STOPPED else State.DISARMED,
                              f"disarmed by {header.source}")
        if verb in (Verb.ACQUIRE, Verb.RELEASE):
            raise WireError(RejectReason.NOT_ALLOWED, "only its vision service can drive a legacy robot")
        with self._lock:
            if header.echo not in self._issued:
                raise WireError(RejectReason.STALE, "cites no status of the last 2 s; repeat the request")
            if verb is Verb.RESET:
                if self._state is not State.STOPPED:
                    return f"nothing to reset: {self._state}"
                self._state, self._reason = State.DISARMED, f"reset by {header.source}; not armed"
                return "reset; arm to drive"
            if self._state is State.STOPPED:
                raise WireError(RejectReason.STOPPED, f"{self._reason}; reset first")
            self._state, self._reason, self._is_at_rest = State.ACTIVE, _DRIVING, False
            return "armed"

    def _halt(self, state: State, reason: str) -> str:
        """Send zero now, without waiting for the next frame. The link repeats it."""
        with self._lock:
            self._issued.clear()
            if self._state is State.ACTIVE:
                self._zero_us = self._now_us()
            if self._state is not state:
                self._state, self._reason = state, reason
            for channel, zero in ((TWIST, _ZERO), (DETECTIONS, _NO_BOX)):
                self._link.publish(channel, b"", zero)
            if self._is_at_rest:
                return "STOPPED" if state is State.STOPPED else "disarmed"
            if self._now_us() - self._zero_us < _PATIENCE_US:
                return ""
        raise WireError(RejectReason.NOT_ALLOWED, _NOT_DELIVERED)

    def _on_frame(self, message: Message) -> None:
        try:
            session, now_us = decode(FrameHeader, message.header).session, self._now_us()
        except WireError:
            return
        with self._lock:
            self._frames_us.append(now_us)
            self._frames += 1
            if session != self._connection:  # the earlier connection may have lost the zero
                self._connection, self._zero_us = session, now_us
            if self._state is State.ACTIVE or self._is_at_rest or now_us - self._zero_us < _IN_FLIGHT_US:
                return
            self._is_at_rest, self._applied = True, (0.0, 0.0)
        self._post_status()

    def _shown(self) -> tuple[State, str]:
        """Return state and reason as shown to the operators."""
        if self._is_at_rest or self._state is State.ACTIVE:
            return self._state, self._reason
        return State.ACTIVE, f"{self._reason}; {_NOT_DELIVERED}"

    # --- status ------------------------------------------------------------------------------------------------------

    def _report(self) -> None:
        while not self._ending.wait(STATUS_PERIOD_S):
            self._post_status()

    def _post_status(self) -> None:
        with self._lock:
            state, reason = self._shown()
            self._frames_us = [one for one in self._frames_us if self._now_us() - one < 1_000_000]
            status = Status(
                state=state, reason=reason, holder=self._holder, applied=self._applied, accepted=self._accepted,
                stream=StreamStatus(sent=self._frames, fps=len(self._frames_us)),
            )
        self._post(STATUS, status)

    def _post(self, channel: Channel, model: WireModel) -> None:
        with self._lock:
            self._seqs[channel] += 1
            stamp = Stamp(session=self._session, seq=self._seqs[channel], t_us=self._now_us())
            if channel is STATUS:
                self._issued.append(Echo.of(stamp))
        self._link.publish(channel, encode(stamp), encode(model))
