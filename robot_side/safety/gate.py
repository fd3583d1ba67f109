"""Accept or reject commands, and decide at every tick how the wheels move. Pure.

`offer` validates a command once, on arrival. `step` checks its age again at each tick and computes the twist.
Only an accepted command proves liveness. Rejected commands, acks and open connections refresh nothing.
"""

import math
from collections import Counter
from collections.abc import Iterator

from sightline.protocol.errors import CLAMPED, RejectReason, WireError
from sightline.protocol.messages import (
    GUEST,
    STILL,
    AnswerHeader,
    Holder,
    LastRejection,
    Request,
    RequestHeader,
    State,
    Twist,
    Verb,
)
from sightline.protocol.proof import NO_PROOF, Proof, session_digest
from sightline.robot_side.safety.battery import BatteryMonitor
from sightline.robot_side.safety.guard import RangeGuard
from sightline.robot_side.safety.lease import HUMANS, RANKS, Lease
from sightline.robot_side.safety.limits import Ramp, SafetyConfig, age_factor, clamp_twist
from sightline.robot_side.safety.states import Cause, Event, is_armed, next_state
from sightline.robot_side.safety.validation import (
    AcceptedCommand,
    CommandResult,
    Decision,
    FreshnessRecord,
    IssuedRecord,
    RepeatRecord,
    SequenceRecord,
)

# A link that was cut delivers its messages later. An old `arm` must not arm (docs/explanation/decisions/0001).
_MAX_REQUEST_AGE_US = 2_000_000
# These verbs only remove motion, so they are accepted at any age.
_NEEDS_NO_ECHO = (Verb.STOP, Verb.DISARM, Verb.RELEASE)


def _proof_of(header: AnswerHeader | RequestHeader | None) -> Proof:
    return NO_PROOF if header is None else Proof(header.proof, header.next_proof)


def _shown(holder: Holder | None) -> str:
    """Return the name of a driver for other clients, without its session, which a peer could copy."""
    return f"{holder.source} {session_digest(holder.source, holder.session)}" if holder else ""


class SafetyGate:
    """The only path from a command to the wheels. The caller steps it at least 50 times a second.

    Args:
        config: limits and times.
        session: session id of this robot start, 8 hex digits. Commands that cite another session are rejected.
        stopped: True if the STOP latch was set when the robot last ended.
        guard: speed limits near obstacles, or None without a range sensor.
        battery: speed limits of the battery, or None without one.
        needs_proof: True to accept only drivers that prove their identity, as on links with keys.

    All times are microseconds of the robot's monotonic clock and never decrease.
    """

    def __init__(
        self,
        config: SafetyConfig,
        session: str,
        *,
        stopped: bool = False,
        guard: RangeGuard | None = None,
        battery: BatteryMonitor | None = None,
        needs_proof: bool = False,
    ) -> None:
        self.config = config
        self.issued = IssuedRecord(session)
        self.pictures = FreshnessRecord()
        self.counters: Counter[str] = Counter()
        self.accepted = 0
        self.last_rejection: LastRejection | None = None
        self.state = State.STOPPED if stopped else State.DISARMED
        self.reason = "STOP was set before the restart" if stopped else "not armed"
        self.applied = STILL
        self.is_taken = True
        """True if the drive accepted the twist of the last step."""
        self._sequence = SequenceRecord()
        self._repeats = RepeatRecord()
        # After this silence no command of the holder is in force.
        self._lease = Lease(config.lease_ms * 1000, max(config.silence_ms, config.zero_speed_age_ms) * 1000)
        self._ramp = Ramp(config)
        self._guard = guard
        self._battery = battery
        self._needs_proof = needs_proof
        self._command: AcceptedCommand | None = None
        self._live_commands = 0
        self.arms_itself = config.auto_arm and not stopped
        self._last_step_us: int | None = None
        self._hold_since_us = 0

    # --- commands ------------------------------------------------------------------------------------------------

    def offer(self, source: str, header: AnswerHeader | None, twist: Twist, now_us: int) -> CommandResult:
        """Validate one command on arrival. Never raises: it counts each rejection and stores the newest.

        Args:
            source: role in the key of the message, e.g. "vision".
            header: decoded header, or None for a guest without a header.
            twist: m/s and rad/s, not yet limited.
            now_us: arrival time on the robot's clock.

        Returns:
            The age of the cited frame in us if the command was accepted, otherwise the reason.
        """
        try:
            age_us = self._validate(source, header, twist, now_us)
        except WireError as error:
            return self.reject(source, error)
        self.accepted += 1
        return CommandResult(None, age_us=age_us)

    def reject(self, source: str, error: WireError) -> CommandResult:
        """Count a rejection. The driver core also calls this for a message that the decoder rejected.

        Args:
            source: role in the key of the message.
            error: its reason and one line of detail for the operator.
        """
        self.counters[error.reason] += 1
        self.last_rejection = LastRejection(source=source[:32], reason=error.reason, detail=error.detail[:200])
        return CommandResult(error.reason, error.detail)

    def _validate(self, source: str, header: AnswerHeader | None, twist: Twist, now_us: int) -> int:
        if not (math.isfinite(twist.linear_mps) and math.isfinite(twist.angular_rad_s)):
            raise WireError(RejectReason.NOT_FINITE, "twist is not finite")
        who, age_us = self._identify(source, header, now_us)
        if self.state in (State.STOPPED, State.FAULT):
            raise WireError(RejectReason(self.state), self.reason)
        self._notice_lost_human(now_us)
        holder = self._lease.live_holder(now_us)
        if not self._lease.may_take(who, now_us, _proof_of(header)):
            raise WireError(RejectReason.NOT_HOLDER, self._why_not(who, holder))
        # The lease is renewed in DISARMED too. Otherwise arming would never find a live driver.
        self._live_commands = self._live_commands + 1 if holder == who else 1
        self._lease.take(who, now_us, _proof_of(header))
        self._sequence.promote((who.source, who.session))
        if not is_armed(self.state):
            raise WireError(RejectReason.DISARMED, self.reason)
        self._accept(source, twist, now_us, age_us if header else None)
        return age_us

    def _identify(self, source: str, header: AnswerHeader | None, now_us: int) -> tuple[Holder, int]:
        """Return the sender and the age of the cited frame in us."""
        if source not in RANKS or (header is not None and header.source != source):
            raise WireError(RejectReason.UNKNOWN_SOURCE, f"unknown source {source!r}, or different from the header")
        if source == "guest" and not self.config.guests:
            raise WireError(RejectReason.UNKNOWN_SOURCE, "guests are switched off (safety.guests)")
        if header is None:
            if source != "guest":
                raise WireError(RejectReason.MALFORMED, f"a twist from {source} needs a header that cites a frame")
            return GUEST, 0
        if header.echo.channel == "status":
            raise WireError(RejectReason.UNKNOWN_FRAME, "a twist must cite a frame, not a status")
        self.issued.age_us(header.echo, now_us, self.config.max_age_us)
        # A frozen camera delivers new frames with an old image. The age of the image counts from its first appearance.
        age_us = now_us - self.pictures.shown_since_us(header.echo.t_us)
        if age_us > self.config.max_age_us:
            raise WireError(RejectReason.STALE, f"the camera image has not changed for {age_us / 1e3:.0f} ms")
        who = Holder(source=header.source, session=header.session)
        # Before the sequence number: a copied identity must not use up the numbers of the driver.
        self._check_proof(who, header, now_us)
        self._sequence.check(header, now_us)
        return who, age_us

    def _check_proof(self, who: Holder, header: AnswerHeader | RequestHeader, now_us: int) -> None:
        """Check that the sender owns the session that it states."""
        if self._needs_proof and header.proof is None:
            raise WireError(RejectReason.NOT_PROVEN, "a robot with keys needs a proof in each command")
        self._lease.check_proof(who, _proof_of(header), now_us)

    def _accept(self, source: str, twist: Twist, now_us: int, age_us: int | None) -> None:
        config, guest = self.config, source == "guest"
        limited = clamp_twist(
            twist,
            min(config.max_linear_mps, config.guest_max_linear_mps) if guest else config.max_linear_mps,
            min(config.max_angular_rad_s, config.guest_max_angular_rad_s) if guest else config.max_angular_rad_s,
        )
        if limited != twist:
            self.counters[CLAMPED] += 1
        life_ms = min(config.silence_ms, config.guest_life_ms) if guest else config.silence_ms
        # Without a header the age of the image is unknown. The command's age counts from its arrival, and it may repeat
        # only briefly.
        if age_us is None:
            self._repeats.add(twist, now_us)
        self._command = AcceptedCommand(limited, now_us - (age_us or 0), now_us, life_ms * 1000, age_us is not None)

    # --- the wheels ----------------------------------------------------------------------------------------------

    def step(self, now_us: int) -> Decision:
        """Compute the twist from now until the next step. Limits hold per elapsed time, not per call.

        Args:
            now_us: time on the robot's clock.

        Returns:
            The twist for the wheels, the state and its reason.
        """
        self._notice_lost_human(now_us)
        self._arm_by_itself(now_us)
        goal = self._goal(now_us) if is_armed(self.state) else STILL
        elapsed_us = 0 if self._last_step_us is None else max(0, now_us - self._last_step_us)
        self._last_step_us = now_us
        self._repeats.drive(self.applied.linear_mps, elapsed_us)
        twist = self._ramp.step(goal, elapsed_us)
        # The guard comes last and acts immediately, because a ramp toward an obstacle moves the robot closer.
        if self._guard is not None:
            twist = self._guarded(self._guard, twist, now_us)
        self.applied = twist
        return Decision(twist, self.state, self.reason)

    def note_drive(self, before: Twist, *, is_taken: bool) -> None:
        """Note whether the drive accepted the last twist. If not, the wheels may still turn with the twist `before`."""
        self.is_taken = is_taken
        # A failed start from zero may have reached one of the two wheels.
        if not is_taken and before != STILL:
            self.applied = before

    def _guarded(self, guard: RangeGuard, twist: Twist, now_us: int) -> Twist:
        limited = guard.limit(twist, now_us)
        if limited != twist:
            # The ramp must restart from the real speed. Otherwise the robot jumps when the obstacle is gone.
            self._ramp.force(limited)
            if is_armed(self.state):
                self.reason = "an obstacle is near" if guard.is_fresh(now_us) else "the range sensor is silent"
        return limited

    def _goal(self, now_us: int) -> Twist:
        """Return the commanded twist under the smallest limit of all causes. A limit of zero means HOLD."""
        command = self._command
        cause = min(self._causes(command, now_us), key=lambda cause: cause.factor)
        if cause.event is Event.MUST_HOLD:
            self._hold(cause.reason, now_us)
        else:
            self._go(cause.event, cause.reason)
        # One factor scales both axes, so that a slower robot still follows the commanded curve.
        twist, config = STILL if command is None else command.twist, self.config
        return clamp_twist(twist, cause.factor * config.max_linear_mps, cause.factor * config.max_angular_rad_s)

    def _causes(self, command: AcceptedCommand | None, now_us: int) -> Iterator[Cause]:
        """Yield every cause that slows or holds the robot. The smallest factor wins, then the first cause."""
        config = self.config
        if self._battery is not None:
            yield from self._battery.causes(now_us)
        if self.pictures.unchanged_us() > config.max_age_us:
            yield Cause(0.0, "the camera image does not change")
        if command is None:
            yield Cause(0.0, "armed; no command yet")
            return
        if now_us - command.arrival_us > command.life_us:
            yield Cause(0.0, f"no accepted command for more than {command.life_us // 1000} ms")
        if self._repeats_too_long(command, now_us):
            yield Cause(0.0, f"the same command without a frame for more than {config.guest_unchanged_ms} ms or "
                             f"{config.guest_unchanged_m:g} m")
        factor = age_factor(config, now_us - command.echo_us)
        if factor == 0.0:
            yield Cause(factor, f"the frame behind the command is {config.zero_speed_age_ms} ms old")
        else:
            yield Cause(factor, "the frame is aging; slower" if factor < 1.0 else "driving")

    def _repeats_too_long(self, command: AcceptedCommand, now_us: int) -> bool:
        max_us, max_m = self.config.guest_unchanged_ms * 1000, self.config.guest_unchanged_m
        return not command.cites_frame and command.twist != STILL and self._repeats.is_over(max_us, max_m, now_us)

    def _hold(self, reason: str, now_us: int) -> None:
        if self.state is not State.HOLD:
            self._hold_since_us = now_us
        self._go(Event.MUST_HOLD, reason)
        if now_us - self._hold_since_us > self.config.disarm_after_hold_s * 1e6:
            self._leave(Event.EXPIRED, f"disarmed after {self.config.disarm_after_hold_s:g} s without commands")

    # --- requests ------------------------------------------------------------------------------------------------

    def request(self, header: RequestHeader, request: Request, now_us: int) -> str:
        """Apply a request.

        Args:
            header: sender and the cited status.
            request: the verb.
            now_us: arrival time on the robot's clock.

        Returns:
            One line for the operator.

        Raises:
            WireError: the request is rejected; `reason` and `detail` name the cause.
        """
        if request.verb not in _NEEDS_NO_ECHO:
            self.issued.check_request(header.echo, now_us, _MAX_REQUEST_AGE_US)
        self._notice_lost_human(now_us)
        who = Holder(source=header.source, session=header.session)
        if request.verb is Verb.STOP:
            return self.stop(f"STOP by {who.source}")
        if request.verb is Verb.DISARM:
            return self.disarm(f"disarmed by {who.source}")
        if request.verb is Verb.ACQUIRE or self._lease.live_holder(now_us) == who:
            self._check_proof(who, header, now_us)
        if request.verb is Verb.ACQUIRE:
            return self.acquire(who, now_us, _proof_of(header))
        self._lease.advance(who, _proof_of(header), now_us)
        handlers = {Verb.ARM: self.arm, Verb.RESET: self.reset, Verb.RELEASE: self.release}
        return handlers[request.verb](who, now_us)

    def stop(self, reason: str = "STOP") -> str:
        """Latch STOPPED. The wheels ramp to zero and stay there until `reset`. Always granted."""
        # Granted in every state and to every source, because it only removes motion.
        self._end(Event.STOP, reason)
        return "STOPPED"

    def fault(self, reason: str) -> None:
        """Enter FAULT after a failure of the drive. The wheels stay at zero until `reset`."""
        # Only on entry: a drive that reports its fault at every tick must not invalidate each new reset request.
        if next_state(self.state, Event.FAULT) is not self.state:
            self._end(Event.FAULT, reason)

    def halt(self, reason: str) -> None:
        """Enter FAULT without a ramp. The caller could not step the gate and has set the wheels to zero."""
        self.fault(reason)
        self._ramp.force(STILL)
        self.applied = STILL

    def disarm(self, reason: str = "disarmed") -> str:
        """Ramp the wheels to zero. Commands are validated but not applied. Always granted."""
        self._end(Event.DISARM, reason)
        return "disarmed"

    def reset(self, who: Holder, now_us: int) -> str:
        """Leave STOPPED or FAULT for DISARMED. This permits motion and never starts it."""
        self._reject_beside_human(who, now_us)
        if self.state not in (State.STOPPED, State.FAULT):
            return f"nothing to reset: {self.state}"
        if not self.is_taken:
            raise WireError(RejectReason.NOT_ALLOWED, "the drive takes no speeds; see its error in the robot's log")
        if self.applied != STILL:
            raise WireError(RejectReason.NOT_ALLOWED, "the wheels are not at zero yet; repeat the request")
        self._leave(Event.RESET, f"reset by {who.source}; not armed")
        return "reset; arm to drive"

    def arm(self, who: Holder, now_us: int) -> str:
        """Permit motion by the lease holder. Its commands must be live and the wheels at zero."""
        self._reject_beside_human(who, now_us)
        if is_armed(self.state):
            return "already armed"
        if self.state is not State.DISARMED:
            raise WireError(RejectReason(self.state), f"{self.reason}; reset first")
        missing = self._missing_to_arm(now_us)
        if missing:
            raise WireError(RejectReason.NOT_ALLOWED, missing)
        self.arms_itself = self.config.auto_arm
        # An operator who arms has looked at the robot, so the repeats start again. `auto_arm` does not restart them.
        self._repeats = RepeatRecord()
        self._begin(f"armed by {who.source}", now_us)
        return "armed"

    def acquire(self, who: Holder, now_us: int, proof: Proof = NO_PROOF) -> str:
        """Take the lease before the first command, and commit to a chain of proofs. Only commands renew the lease."""
        if who.source not in RANKS or not self._lease.may_take(who, now_us, proof):
            raise WireError(RejectReason.NOT_HOLDER, self._why_not(who, self._lease.live_holder(now_us)))
        if self._lease.live_holder(now_us) == who:
            self._lease.advance(who, proof, now_us)
            return "already held"
        # The commands of the previous driver must neither arm the robot nor move it for the new one.
        self._live_commands, self._command = 0, None
        self._lease.take(who, now_us, proof)
        return "acquired"

    def release(self, who: Holder, now_us: int) -> str:
        """Return the lease. After a human driver the robot stops and must be armed again."""
        if self._lease.live_holder(now_us) != who:
            return "not held"
        self._lease.drop()
        self._command = None
        if who.source in HUMANS:
            # The robot never returns from a human to vision without an operator.
            self._end(Event.HUMAN_LOST, "the operator released control; arm again")
        return "released"

    def add_token(self, token: str) -> None:
        """Store the token of a driver (`protocol/transports/tokens.py`)."""
        self._lease.add_token(token)

    def end_token(self, token: str, now_us: int) -> bool:
        """End the lease of the driver with this token. Returns True if that driver held the lease.

        Its last command stays in force until it is too old, so that the robot does not stop for a successor.
        """
        return self._lease.end_token(token, now_us)

    def _why_not(self, who: Holder, holder: Holder | None) -> str:
        if self._lease.is_fenced(who):
            return f"the token of this session ended; {who.source} needs a new session"
        if holder is not None:
            return f"{_shown(holder)} drives"
        return f"the token of this {who.source} just ended" if who.source in RANKS else f"{who.source} may not drive"

    def holder(self, now_us: int) -> Holder | None:
        """Return the driver that holds the lease now, or None."""
        return self._lease.live_holder(now_us)

    @property
    def latency_us(self) -> int | None:
        """Return the time in us from capture to acceptance of the last command, or None if it cites no frame."""
        command = self._command
        return command.arrival_us - command.echo_us if command is not None and command.cites_frame else None

    def frame_age_us(self, now_us: int) -> int | None:
        """Return the age in us of the frame behind the current command, or None if the command cites no frame."""
        command = self._command
        return max(0, now_us - command.echo_us) if command is not None and command.cites_frame else None

    def _reject_beside_human(self, who: Holder, now_us: int) -> None:
        # While a human drives, no other operator may arm or reset.
        holder = self._lease.live_holder(now_us)
        if holder is not None and holder.source in HUMANS and holder != who:
            raise WireError(RejectReason.NOT_ALLOWED, f"{_shown(holder)} drives")

    def _missing_to_arm(self, now_us: int) -> str:
        """Return the condition that still prevents arming, or an empty string."""
        needed = self.config.live_commands_to_arm
        if self._lease.live_holder(now_us) is None:
            return "no valid commands yet; start the vision service"
        if self._live_commands < needed:
            return f"{self._live_commands} of {needed} live commands received; repeat the request"
        return "" if self.applied == STILL else "the wheels are not at zero yet; repeat the request"

    def _notice_lost_human(self, now_us: int) -> None:
        """Stop after the loss of a human driver."""
        # Before another driver may take the lease, because one tick later the new holder hides the loss.
        if self._lease.lost_human(now_us):
            self._lease.drop()
            self._end(Event.HUMAN_LOST, "the operator who drove was lost; arm again")

    def _arm_by_itself(self, now_us: int) -> None:
        if self.arms_itself and self.state is State.DISARMED and not self._missing_to_arm(now_us):
            self._begin("armed by itself (auto_arm)", now_us)

    def _begin(self, reason: str, now_us: int) -> None:
        self._command, self._hold_since_us = None, now_us
        self._go(Event.ARM, reason)

    def _end(self, event: Event, reason: str) -> None:
        """Leave the armed states, and invalidate earlier requests and auto_arm, so that neither arms again."""
        self._leave(event, reason)
        self.issued.deny_earlier()
        self.arms_itself = False

    def _leave(self, event: Event, reason: str) -> None:
        """Go to a state without motion. With auto_arm the robot may arm again from there."""
        if next_state(self.state, event) is not self.state:
            self._command, self._live_commands = None, 0
            self._go(event, reason)

    def _go(self, event: Event, reason: str) -> None:
        self.state = next_state(self.state, event)
        self.reason = reason
