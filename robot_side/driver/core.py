"""Logic of the driver process: messages in, wheel speeds and messages out. Pure."""

from collections import Counter
from collections.abc import Iterator

from sightline.protocol.channels import ODOMETRY, REPLY, SCAN, STATUS, Channel
from sightline.protocol.codec import check_sizes, decode, encode, encode_ranges
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import (
    STILL,
    AnswerHeader,
    Holder,
    LeaseHolder,
    Odometry,
    Planar,
    Pose,
    Reply,
    Request,
    RequestHeader,
    ScanHeader,
    Stamp,
    State,
    Status,
    StreamStatus,
    WireModel,
)
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.kinematics import EncoderMonitor, Odometer, check_finite, wheel_speeds
from sightline.robot_side.pipe import CommandAck, RobotMotion
from sightline.robot_side.ports import Ranges, WheelAngles
from sightline.robot_side.safety.battery import BatteryMonitor
from sightline.robot_side.safety.gate import SafetyGate
from sightline.robot_side.safety.guard import RangeGuard

_PERIODS_US = {STATUS.name: 100_000, ODOMETRY.name: 50_000}
_RETURNS_NO_CREDIT = (
    RejectReason.UNKNOWN_SOURCE, RejectReason.OTHER_SESSION, RejectReason.UNKNOWN_FRAME, RejectReason.FROM_FUTURE,
    RejectReason.NOT_PROVEN,
)  # fmt: skip

_AHEAD_US = 1_000_000  # a wheel reading further in the future has another clock, and would make later readings old
_WIRE_LIMIT = 1e6  # limit of any number on the wire: an encoder that wraps around must not cause an error


def _bounded(pair: Planar) -> Planar:
    return _within(pair[0]), _within(pair[1])


def _bounded_pose(pose: Pose) -> Pose:
    return _within(pose[0]), _within(pose[1]), pose[2]


def _within(value: float) -> float:
    return max(-_WIRE_LIMIT, min(_WIRE_LIMIT, value))


class DriverCore:
    """One robot session. The shell passes the inputs and calls `tick` at least 50 times a second."""

    def __init__(self, config: RobotConfig, session: str, *, stopped: bool = False) -> None:
        self.config = config
        self.session = session
        self._guard = RangeGuard(config.guard) if config.ranging else None
        self.battery = BatteryMonitor(config.safety) if config.battery else None
        self.gate = SafetyGate(
            config.safety, session, stopped=stopped, guard=self._guard, battery=self.battery,
            needs_proof=bool(config.secure),
        )
        self.odometer = Odometer(config.wheels)
        self._encoders = EncoderMonitor(config.wheels)
        self.doubtful_wheel = ""
        """Contradiction of command and encoders in the last tick, or empty."""
        self.stream = StreamStatus()
        self.tick_late_max_us = 0
        self.network_restarts = 0
        self.rejected_by_transport: Counter[str] = Counter()
        """Number of messages that the transport rejected before the gate, by reason."""
        self.faults: Counter[str] = Counter()
        """Number of exceptions in each part, in this process and in the network processes."""
        self.latch_failed = ""
        """Why the disk does not have the current STOP latch, or empty."""
        self._seqs: dict[str, int] = {}
        self._due_us: dict[str, int] = {}
        self._outbox: list[Message] = []

    # --- inputs --------------------------------------------------------------------------------------------------

    def on_issued(self, seq: int, t_us: int, fingerprint: int) -> None:
        """Record a frame before the network process publishes it.

        Args:
            seq: number of the frame.
            t_us: capture time, us.
            fingerprint: checksum of the image bytes; 0 without one.
        """
        self.gate.issued.add("frame", seq, t_us)
        self.gate.pictures.add(t_us, fingerprint)

    def on_twist(self, message: Message, now_us: int) -> CommandAck | None:
        """Decode a command and offer it to the gate. Returns its credit, if it answers a frame of this robot."""
        try:
            check_sizes(message.channel, message.header, message.payload)
            header = decode(AnswerHeader, message.header) if message.header else None
            twist = parse_twist(message.payload)
        except WireError as error:
            self.gate.reject(message.source, error)
            return None
        result = self.gate.offer(message.source, header, twist, now_us)
        if header is None or result.reason in _RETURNS_NO_CREDIT:
            return None
        sender = Holder(source=header.source, session=header.session)
        return CommandAck(sender, header.echo.seq, header.compute_us, self.gate.holder(now_us))

    def on_token(self, token: str, is_present: bool, now_us: int) -> None:
        """Note that the token of a driver appeared or ended."""
        if is_present:
            self.gate.add_token(token)
        else:
            self.gate.end_token(token, now_us)

    def on_battery(self, volts: float, t_us: int) -> None:
        """Store the newest voltage, V, and the time of its reading."""
        if self.battery is not None:
            self.battery.see(volts, t_us)

    def on_request(self, message: Message, now_us: int) -> None:
        """Apply a request; the reply waits in `messages`."""
        try:
            check_sizes(message.channel, message.header, message.payload)
            header = decode(RequestHeader, message.header)
            request = decode(Request, message.payload)
        except WireError as error:
            self.gate.reject(message.source, error)
            return
        try:
            if header.source != message.source:
                raise WireError(RejectReason.UNKNOWN_SOURCE, "key and header disagree on the source")
            detail, granted = self.gate.request(header, request, now_us), True
        except WireError as error:
            self.gate.reject(message.source, error)
            detail, granted = f"{error.reason}: {error.detail}"[:200], False
        reply = Reply(to=header.digest, id=request.id, ok=granted, state=self.gate.state, detail=detail)
        self._post(REPLY, reply, now_us)

    # --- outputs -------------------------------------------------------------------------------------------------

    def tick(self, now_us: int, wheels: WheelAngles | None, scan: Ranges | None) -> tuple[float, float]:
        """Process the sensor readings, step the gate, and return (left, right) rad/s for the motors.

        Raises:
            ValueError: an angle is not finite, or its time is in the future.
        """
        self.doubtful_wheel = ""
        if wheels is not None:
            if (ahead_us := wheels.t_us - now_us) > _AHEAD_US:
                raise ValueError(f"WheelAngles.t_us is {ahead_us / 1e6:.3g} s ahead; take the robot's clock")
            check_finite(wheels)
            speeds = wheel_speeds(self.config.wheels, self.gate.applied)
            self.doubtful_wheel = self._encoders.look(speeds, wheels, now_us)
            (self.odometer.restart if self._encoders.jumped else self.odometer.update)(wheels)
        if scan is not None:
            self._on_scan(scan, now_us)
        decision = self.gate.step(now_us)
        return wheel_speeds(self.config.wheels, decision.twist)

    def motion(self) -> RobotMotion:
        """Return the current motion of the robot, for frame headers."""
        applied = self.gate.applied
        return RobotMotion(
            _bounded_pose(self.odometer.pose),
            _bounded(self.odometer.moving),
            (applied.linear_mps, applied.angular_rad_s),
            self.gate.latency_us,
        )

    def messages(self, now_us: int) -> Iterator[Message]:
        """Yield the messages to publish now: replies and scans immediately, status and odometry at their rates."""
        if self._is_due(ODOMETRY, now_us):
            self._post(ODOMETRY, Odometry(pose=self.motion().pose, moving=self.motion().moving), now_us)
        if self._is_due(STATUS, now_us):
            self._post(STATUS, self.status(now_us), now_us)
        outbox, self._outbox = self._outbox, []
        yield from outbox

    def status(self, now_us: int) -> Status:
        """Return all data that explains to an operator why the robot moves or stands."""
        gate, limits, holder = self.gate, self.config.safety, self.gate.holder(now_us)
        return Status(
            # Wheels of an earlier process may turn, whatever `applied` is, so no STOP may count as applied.
            state=gate.state if gate.is_taken else State.FAULT,
            reason=self._reason(),
            holder=LeaseHolder.of(holder.source, holder.session) if holder else None,
            applied=(gate.applied.linear_mps, gate.applied.angular_rad_s),
            frame_age_us=gate.frame_age_us(now_us),
            latency_us=gate.latency_us,
            accepted=gate.accepted,
            refused=dict(gate.counters + self.rejected_by_transport),
            last_refusal=gate.last_rejection,
            stream=self.stream,
            auto_arm=gate.arms_itself,
            tick_late_max_us=self.tick_late_max_us,
            network_restarts=self.network_restarts,
            faults=dict(self.faults),
            battery_v=self._battery_v(now_us),
            max_linear_mps=limits.max_linear_mps,
            max_angular_rad_s=limits.max_angular_rad_s,
        )

    @property
    def at_rest(self) -> bool:
        """Return True when the commanded wheel speeds are zero."""
        return self.gate.applied == STILL

    # --- inside --------------------------------------------------------------------------------------------------

    def _on_scan(self, scan: Ranges, now_us: int) -> None:
        if self._guard is not None:
            self._guard.see(scan)
        stamp = self._stamp(SCAN, now_us)
        header = ScanHeader(
            session=stamp.session,
            seq=stamp.seq,
            t_us=scan.t_us,
            angle_min_rad=scan.angle_min_rad,
            angle_increment_rad=scan.angle_increment_rad,
            range_min_m=scan.range_min_m,
            range_max_m=min(scan.range_max_m, _WIRE_LIMIT),
        )
        payload = encode_ranges(scan.ranges_m)
        if len(payload) <= SCAN.max_payload_bytes:
            self._outbox.append(Message(SCAN, "", encode(header), payload))

    def _reason(self) -> str:
        stored = f"; not stored for a restart: {self.latch_failed}" if self.latch_failed else ""
        is_known = self.gate.is_taken or self.gate.state is State.FAULT  # the gate's reason already names the drive
        more = stored if is_known else f"; the drive takes no speeds{stored}"
        return (self.gate.reason[: 200 - len(more)] + more)[:200]

    def _battery_v(self, now_us: int) -> float | None:
        volts = self.battery.volts(now_us) if self.battery else None
        return None if volts is None else _within(volts)

    def _is_due(self, channel: Channel, now_us: int) -> bool:
        due_us = self._due_us.get(channel.name, now_us)
        if now_us < due_us:
            return False
        self._due_us[channel.name] = max(due_us + _PERIODS_US[channel.name], now_us)
        return True

    def _post(self, channel: Channel, payload: WireModel, now_us: int) -> None:
        self._outbox.append(Message(channel, "", encode(self._stamp(channel, now_us)), encode(payload)))

    def _stamp(self, channel: Channel, now_us: int) -> Stamp:
        seq = self._seqs[channel.name] = self._seqs.get(channel.name, -1) + 1
        if channel is STATUS:
            self.gate.issued.add("status", seq, now_us)  # so that a request may cite it
        return Stamp(session=self.session, seq=seq, t_us=now_us)
