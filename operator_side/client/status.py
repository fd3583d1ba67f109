"""A robot's status as text. Pure."""

from collections.abc import Iterator

from sightline.protocol.messages import Status, StreamStatus


def status_line(robot: str, status: Status) -> str:
    """One line: who, in which state, why, driven by whom."""
    holder = f", driven by {status.holder.source}" if status.holder else ""
    return f"{robot}: {status.state} ({status.reason}){holder}"


def status_lines(robot: str, status: Status) -> Iterator[str]:
    """Everything a person needs to know why the robot moves or does not."""
    stream = status.stream
    holder = f"{status.holder.source} {status.holder.session}" if status.holder else "nobody"
    yield f"robot     {robot}"
    yield f"state     {status.state}: {status.reason}"
    yield f"driver    {holder}" + ("; arms by itself" if status.auto_arm else "")
    yield f"wheels    {twist_text(status.applied)}"
    yield f"limits    {status.max_linear_mps:.2f} m/s, {status.max_angular_rad_s:.2f} rad/s"
    if status.battery_v is not None:
        yield f"battery   {status.battery_v:.2f} V"
    yield f"sight     frame age {millis(status.frame_age_us)}, capture to command {millis(status.latency_us)}"
    camera = "calibrated" if stream.calibrated else "not calibrated"
    counts = f"{stream.sent} sent, {stream.credit_timeouts} unanswered"
    yield f"stream    {stream.fps:.0f} fps, {counts}, window {stream.window}, camera {camera}"
    yield f"pictures  {encoding_text(stream)}"
    yield f"dropped   {drops_text(stream)}"
    yield f"commands  {status.accepted} accepted, {refusals_text(status)}, {stream.dropped_commands} dropped"
    if status.last_refusal:
        last = status.last_refusal
        yield f"refused   last: {last.reason} from {last.source}: {last.detail}"
    yield f"driver loop late by at most {millis(status.tick_late_max_us)}; network restarts {status.network_restarts}"


def stream_is_whole(stream: StreamStatus) -> bool:
    """Whether pictures are encoded as configured: the link carries what was asked for."""
    return stream.quality_percent == stream.scale_percent == 100


def encoding_text(stream: StreamStatus) -> str:
    """How pictures are encoded to fit the link."""
    if stream_is_whole(stream):
        return "as configured"
    return f"made smaller for this link: quality {stream.quality_percent} %, side length {stream.scale_percent} %"


def drops_text(stream: StreamStatus) -> str:
    """What was replaced by something newer, slot by slot."""
    parts = [
        f"{stream.missed_captures} captures in the camera's slot" if stream.missed_captures else "",
        *(f"{count} {name} on the way out" for name, count in stream.dropped.items()),
        f"{stream.overtaken} frames overtaken before an answer" if stream.overtaken else "",
        f"{stream.refused_pictures} pictures refused" if stream.refused_pictures else "",
    ]
    return ", ".join(part for part in parts if part) or "nothing"


def refusals_text(status: Status) -> str:
    """Every refusal counter, most frequent first."""
    counted = sorted(status.refused.items(), key=lambda item: -item[1])
    return "refused: " + ", ".join(f"{name} {count}" for name, count in counted) if counted else "none refused"


def twist_text(twist: tuple[float, float]) -> str:
    """(m/s, rad/s) with signs, so that forward and left are seen."""
    return f"{twist[0]:+.2f} m/s {twist[1]:+.2f} rad/s"


def millis(time_us: int | None) -> str:
    """Microseconds as milliseconds, `-` for none."""
    return "-" if time_us is None else f"{time_us / 1000:.0f} ms"
