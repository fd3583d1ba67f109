"""Robots that arm, disarm, stop or reset wrongly. Pure."""

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import STILL, Holder, State, Twist, Verb
from sightline.robot_side.safety.lease import RANKS
from sightline.robot_side.safety.validation import AcceptedCommand, CommandResult
from tests.conformance.robot.broken.breaking import breaks, wrap


def on_verb(robot, verb, around):
    """`around(inner, header, request, now_us)` for requests of one verb."""

    def choose(inner, header, request, now_us):
        return around(inner, header, request, now_us) if request.verb is verb else inner(header, request, now_us)

    wrap(robot.driving.gate, "request", choose)


def forgives(robot, verb, when):
    """Requests of `verb` whose echo `when(echo, now_us)` cite the newest status instead, STOP or no STOP."""
    issued = robot.driving.gate.issued

    def around(inner, header, request, now_us):
        if not when(header.echo, now_us):
            return inner(header, request, now_us)
        times = issued._times["status"]
        seq = next(reversed(times))
        echo = {"channel": "status", "session": issued.session, "seq": seq, "t_us": times[seq]}
        denied, issued._denied_seq = issued._denied_seq, -1
        try:
            return inner(header.model_validate({**header.model_dump(), "echo": echo}), request, now_us)
        finally:
            issued._denied_seq = max(denied, issued._denied_seq)

    on_verb(robot, verb, around)


def absent(echo, _now_us):
    return echo is None


def late(echo, now_us):
    return echo is not None and now_us - echo.t_us > 2_000_000


def denied(robot):
    return lambda echo, _now_us: echo is not None and echo.seq <= robot.driving.gate.issued._denied_seq


@breaks("R-ARM-01")
def arms_for_nobody(robot):
    gate = robot.driving.gate
    wrap(gate, "_missing_to_arm", lambda inner, now_us: inner(now_us) if gate.holder(now_us) else "")


@breaks("R-ARM-02")
def four_commands_will_do(robot):
    gate = robot.driving.gate

    def missing(inner, now_us):
        ready = gate.holder(now_us) and gate._live_commands >= 4 and gate.applied == STILL
        return "" if ready else inner(now_us)

    wrap(gate, "_missing_to_arm", missing)


@breaks("R-ARM-03", "R-ARM-15", "R-DIAL-09")
def never_arms(robot):
    robot.driving.gate._missing_to_arm = lambda now_us: "not today"


@breaks("R-ARM-04")
def accepts_unarmed(robot):
    gate = robot.driving.gate

    def around(inner, source, error):
        if error.reason != "DISARMED":
            return inner(source, error)
        gate.accepted += 1
        return CommandResult(None, age_us=0)

    wrap(gate, "reject", around)


@breaks("R-ARM-05")
def disarm_is_a_word(robot):
    gate = robot.driving.gate

    def disarm(reason="disarmed"):
        gate.issued.deny_earlier()
        return "disarmed"

    gate.disarm = disarm


@breaks("R-ARM-06")
def arms_without_echo(robot):
    forgives(robot, Verb.ARM, absent)


@breaks("R-ARM-07")
def arms_late(robot):
    forgives(robot, Verb.ARM, lambda echo, now_us: late(echo, now_us) and now_us - echo.t_us < 2_400_000)


@breaks("R-ARM-08", "R-ARM-16")
def arms_from_before_the_disarm(robot):
    forgives(robot, Verb.ARM, denied(robot))


@breaks("R-ARM-19")
def acquires_from_before_the_disarm(robot):
    forgives(robot, Verb.ACQUIRE, denied(robot))


@breaks("R-ARM-18")
def arms_turning_wheels(robot):
    at_rest(robot, "arm")


@breaks("R-ARM-09")
def arms_beside_a_human(robot):
    gate = robot.driving.gate
    wrap(gate, "arm", lambda inner, who, now_us: inner(gate.holder(now_us) or who, now_us))


def permits_earlier(robot, name):
    """After the method `name` of the gate, a status from before still permits as much as it did."""
    issued = robot.driving.gate.issued

    def around(inner, *arguments):
        denied = issued._denied_seq
        try:
            return inner(*arguments)
        finally:
            issued._denied_seq = denied

    wrap(robot.driving.gate, name, around)


@breaks("R-ARM-16")
def arms_from_before_a_human_let_go(robot):
    permits_earlier(robot, "release")


@breaks("R-ARM-17")
def resets_from_before_a_human_was_lost(robot):
    permits_earlier(robot, "_notice_lost_human")


@breaks("R-ARM-10")
def arms_only_once(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us):
        detail = inner(who, now_us)
        if detail == "already armed":
            raise WireError(RejectReason.NOT_ALLOWED, detail)
        return detail

    wrap(gate, "arm", around)


@breaks("R-ARM-11")
def counts_everybodys_commands(robot):
    gate, total, last = robot.driving.gate, [0], [None]

    def around(inner, *arguments):
        before, held = gate._lease.expires_us, gate.holder(arguments[-1])
        verdict = inner(*arguments)
        if gate._lease.expires_us > before:
            who = gate._lease.holder
            total[0] = total[0] + 1 if held == who or who != last[0] else 1  # who comes back begins again
            gate._live_commands, last[0] = total[0], who
        return verdict

    wrap(gate, "offer", around)


@breaks("R-ARM-12")
def obeys_what_came_before(robot):
    gate = robot.driving.gate

    def around(inner, reason, now_us):
        inner(reason, now_us)
        gate._command = AcceptedCommand(Twist(linear_mps=0.2, angular_rad_s=0.0), now_us, now_us, 300_000, True)

    wrap(gate, "_begin", around)


# --- STOP -----------------------------------------------------------------------------------------------------------


@breaks("R-STOP-01")
def stop_while_driving_only_disarms(robot):
    gate = robot.driving.gate
    driven = (State.ACTIVE, State.DEGRADED)
    wrap(gate, "stop", lambda inner, reason="STOP": gate.disarm() if gate.state in driven else inner(reason))


@breaks("R-STOP-02")
def viewers_may_not_stop(robot):
    def around(inner, header, request, now_us):
        if header.source == "viewer":
            raise WireError(RejectReason.NOT_ALLOWED, "viewers only view")
        return inner(header, request, now_us)

    on_verb(robot, Verb.STOP, around)


def _needs(condition, reason):
    def around(inner, header, request, now_us):
        if not condition(header.echo, now_us):
            raise WireError(RejectReason(reason), "not so")
        return inner(header, request, now_us)

    return around


@breaks("R-ARM-15")
def requests_live_for_half_a_second(robot):
    on_verb(robot, Verb.ARM, _needs(lambda echo, now_us: echo is None or now_us - echo.t_us < 500_000, "STALE"))


@breaks("R-STOP-03")
def stop_needs_an_echo(robot):
    on_verb(robot, Verb.STOP, _needs(lambda echo, now_us: echo is not None, "MALFORMED"))


@breaks("R-STOP-21")
def stop_cites_this_session(robot):
    issued = robot.driving.gate.issued
    on_verb(robot, Verb.STOP, _needs(lambda echo, _now_us: echo is None or echo.session == issued.session, "STALE"))


@breaks("R-STOP-20")
def stop_needs_a_proof(robot):
    def around(inner, header, request, now_us):
        robot.driving.gate._check_proof(Holder(source=header.source, session=header.session), header, now_us)
        return inner(header, request, now_us)

    on_verb(robot, Verb.STOP, around)


@breaks("R-ARM-22")
def humans_are_never_disarmed(robot):
    def around(inner, header, request, now_us):
        holder = robot.driving.gate.holder(now_us)
        if holder is not None and holder.source == "teleop" and header.source != "teleop":
            raise WireError(RejectReason.NOT_ALLOWED, "a human drives")
        return inner(header, request, now_us)

    on_verb(robot, Verb.DISARM, around)


@breaks("R-STOP-04")
def judges_on_in_stopped(robot):
    gate = robot.driving.gate

    def around(inner, source, error):
        reason = RejectReason.DISARMED if error.reason == "STOPPED" and source in RANKS else error.reason
        return inner(source, WireError(reason, error.detail))

    wrap(gate, "reject", around)


@breaks("R-STOP-05")
def arming_lifts_the_latch(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us):
        if gate.state is State.STOPPED:
            gate.state = State.DISARMED
            return "armed"
        return inner(who, now_us)

    wrap(gate, "arm", around)


@breaks("R-STOP-06")
def reset_arms(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us):
        detail = inner(who, now_us)
        if gate.state is State.DISARMED:
            gate._begin("armed by reset", now_us)
        return detail

    wrap(gate, "reset", around)


@breaks("R-STOP-07")
def resets_without_echo(robot):
    forgives(robot, Verb.RESET, absent)


@breaks("R-STOP-08", "R-ARM-17")
def resets_from_before_the_stop(robot):
    forgives(robot, Verb.RESET, denied(robot))


@breaks("R-STOP-09")
def latch_ends_with_the_connection(robot):
    def tick(inner, now_us):
        if not robot.link.connected and robot.driving.gate.state is State.STOPPED:
            robot.driving.gate.state = State.DISARMED
        inner(now_us)

    wrap(robot, "tick", tick)


@breaks("R-STOP-10")
def disarm_lifts_the_latch(robot):
    gate = robot.driving.gate

    def around(inner, reason="disarmed"):
        if gate.state is State.STOPPED:
            gate.state = State.DISARMED
        return inner(reason)

    wrap(gate, "disarm", around)


@breaks("R-STOP-11")
def second_stop_is_refused(robot):
    gate = robot.driving.gate

    def around(inner, header, request, now_us):
        if gate.state is State.STOPPED:
            raise WireError(RejectReason.NOT_ALLOWED, "stopped already")
        return inner(header, request, now_us)

    on_verb(robot, Verb.STOP, around)


@breaks("R-STOP-12")
def late_stops_are_stale(robot):
    on_verb(robot, Verb.STOP, _needs(lambda echo, now_us: not late(echo, now_us), "STALE"))


@breaks("R-STOP-13")
def reset_disarms(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us):
        if gate.state in (State.HOLD, State.ACTIVE, State.DEGRADED):
            return gate.disarm()
        return inner(who, now_us)

    wrap(gate, "reset", around)


@breaks("R-STOP-14")
def never_arms_again(robot):
    gate, stopped = robot.driving.gate, []
    wrap(gate, "reset", lambda inner, who, now_us: stopped.append(who) or inner(who, now_us))
    wrap(gate, "_missing_to_arm", lambda inner, now_us: "it was stopped once" if stopped else inner(now_us))


@breaks("R-STOP-17")
def stopped_robots_grant_no_disarm(robot):
    gate = robot.driving.gate

    def around(inner, header, request, now_us):
        if gate.state is State.STOPPED:
            raise WireError(RejectReason.NOT_ALLOWED, "stopped")
        return inner(header, request, now_us)

    on_verb(robot, Verb.DISARM, around)


@breaks("R-STOP-15")
def resets_turning_wheels(robot):
    at_rest(robot, "reset")


def at_rest(robot, name):
    """The method `name` of the gate believes that the wheels are at zero."""
    gate = robot.driving.gate

    def around(inner, who, now_us):
        applied, gate.applied = gate.applied, STILL
        try:
            return inner(who, now_us)
        finally:
            gate.applied = applied

    wrap(gate, name, around)


@breaks("R-STOP-16")
def resets_beside_a_human(robot):
    gate = robot.driving.gate
    wrap(gate, "reset", lambda inner, who, now_us: inner(gate.holder(now_us) or who, now_us))
