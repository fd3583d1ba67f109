"""A robot's status and replies as text. Pure."""

from collections.abc import Iterator, Mapping
from typing import Final

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import Reply, State, Status, StreamStatus, Verb

_LATCHED: Final = (RejectReason.STOPPED, RejectReason.FAULT)


def status_line(robot: str, status: Status) -> str:
    """Format robot, state, reason and driver as one line."""
    holder = f", driven by {status.holder.source}" if status.holder else ""
    return f"{robot}: {status.state} ({status.reason}){holder}"


def reply_line(robot: str, verb: Verb, reply: Reply, driver: str = "") -> str:
    """Format the answer to a request, with the next command for the operator.

    Args:
        robot: robot id.
        verb: the request.
        reply: reply of the robot.
        driver: source that holds the lease, or "".

    Returns:
        One line.
    """
    if not reply.ok:
        reason, _, words = reply.detail.partition(": ")
        fix = f"; run `sightline reset {robot}`, then arm again" if reason in _LATCHED else ""
        return f"robot {robot} rejected {verb} ({reason}): {words.removesuffix('; reset first')}{fix}"
    if verb is Verb.ARM:
        done = "was already armed" if reply.detail.startswith("already") else "is armed"
        follows = f"it follows the commands of {driver}" if driver else "it moves when valid commands arrive"
        return f"{robot} {done} ({reply.state}); {follows}; `sightline stop {robot}` stops it"
    if verb is Verb.DISARM:
        return f"{robot} is disarmed; `sightline arm {robot}` permits motion again"
    if verb is Verb.RESET and reply.detail.startswith("reset"):
        return f"{robot} is reset and disarmed; `sightline arm {robot}` permits motion again"
    return f"{robot}: {reply.detail} ({reply.state})"


def short_lines(robot: str, status: Status) -> Iterator[str]:
    """Format the most important fields, in the columns of `status_lines`."""
    yield f"robot     {robot}"
    yield f"state     {status.state}: {status.reason}"
    yield f"driver    {status.holder.source if status.holder else 'none'}"
    yield f"wheels    {twist_text(status.applied)}"
    yield f"image     frame age {millis(status.frame_age_us)}, {status.stream.fps:.0f} fps"
    yield from fault_lines(status)
    if status.battery_v is not None:
        yield f"battery   {status.battery_v:.2f} V"
    if command := next_step(robot, status):
        yield f"next      {command}"


def next_step(robot: str, status: Status) -> str:
    """Return the operator's next command, or ""."""
    if status.state in (State.STOPPED, State.FAULT):
        return f"sightline reset {robot}"
    if status.state is State.DISARMED and not status.auto_arm:
        return f"sightline arm {robot}" if status.holder else "sightline vision, or sightline teleop, to drive it"
    return ""


def status_lines(robot: str, status: Status) -> Iterator[str]:
    """Format every field of a status."""
    stream = status.stream
    holder = f"{status.holder.source} {status.holder.digest}" if status.holder else "none"
    yield f"robot     {robot}"
    yield f"state     {status.state}: {status.reason}"
    yield f"driver    {holder}" + ("; arms automatically" if status.auto_arm else "")
    yield f"wheels    {twist_text(status.applied)}"
    yield f"limits    {status.max_linear_mps:.2f} m/s, {status.max_angular_rad_s:.2f} rad/s"
    if status.battery_v is not None:
        yield f"battery   {status.battery_v:.2f} V"
    yield f"image     frame age {millis(status.frame_age_us)}, capture to command {millis(status.latency_us)}"
    camera = "calibrated" if stream.calibrated else "not calibrated"
    counts = f"{stream.sent} sent, {stream.credit_timeouts} unanswered"
    yield from fault_lines(status)
    yield f"stream    {stream.fps:.0f} fps, {counts}, window {stream.window}, camera {camera}"
    yield f"encoding  {encoding_text(stream)}"
    yield f"dropped   {drops_text(stream)}"
    yield f"commands  {status.accepted} accepted, {rejections_text(status)}, {stream.dropped_commands} dropped"
    if status.last_refusal:
        last = status.last_refusal
        yield f"rejected  last: {last.reason} from {last.source}: {last.detail}"
    yield f"loop      at most {millis(status.tick_late_max_us)} late; {status.network_restarts} network restarts"


def fault_lines(status: Status) -> Iterator[str]:
    """Format the fault of the camera and the exceptions so far; empty without both."""
    if status.stream.camera_fault:
        yield f"camera    {status.stream.camera_fault}"
    if status.faults:
        yield f"faults    {counts_text(status.faults)}; the robot's log has the details"


def counts_text(counts: Mapping[str, int]) -> str:
    """List counts by name, most frequent first."""
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items(), key=lambda item: -item[1]))


def stream_is_whole(stream: StreamStatus) -> bool:
    """Return True if the robot sends its images with the configured quality and size."""
    return stream.quality_percent == stream.scale_percent == 100


def encoding_text(stream: StreamStatus) -> str:
    """Describe the encoding of images, which adapts to the link."""
    if stream_is_whole(stream):
        return "as configured"
    return f"reduced for this link: quality {stream.quality_percent} %, side length {stream.scale_percent} %"


def drops_text(stream: StreamStatus) -> str:
    """List the messages that newer ones replaced, by slot."""
    parts = [
        f"{stream.missed_captures} captures in the camera's slot" if stream.missed_captures else "",
        *(f"{count} {name} before sending" for name, count in stream.dropped.items()),
        f"{stream.overtaken} frames overtaken before an answer" if stream.overtaken else "",
        f"{stream.refused_pictures} invalid images" if stream.refused_pictures else "",
    ]
    return ", ".join(part for part in parts if part) or "nothing"


def rejections_text(status: Status) -> str:
    """List the rejection counters, most frequent first."""
    return "rejected: " + counts_text(status.refused) if status.refused else "0 rejected"


def twist_text(twist: tuple[float, float]) -> str:
    """Format a twist in m/s and rad/s with signs: positive is forward and left."""
    return f"{twist[0]:+.2f} m/s {twist[1]:+.2f} rad/s"


def millis(time_us: int | None) -> str:
    """Format microseconds as milliseconds, `-` for None."""
    return "-" if time_us is None else f"{time_us / 1000:.0f} ms"
