"""Robots whose wheels do something wrong: limits and silence. Pure."""

from sightline.protocol.errors import CLAMPED, RejectReason, WireError
from sightline.protocol.messages import State, Twist
from sightline.robot_side.kinematics import twist_of, wheel_speeds
from sightline.robot_side.safety.validation import AcceptedCommand
from tests.conformance.robot.broken.breaking import bend_out, breaks, fields_of, wrap
from tests.conformance.robot.broken.lease import who_sends

STILL = Twist(linear_mps=0.0, angular_rad_s=0.0)


def keeps(robot, change):
    """`change(command, asked)` gives the command in force in place of the accepted one."""
    gate = robot.driving.gate

    def around(inner, source, twist, now_us, age_us):
        inner(source, twist, now_us, age_us)
        gate._command = change(gate._command, twist)

    wrap(gate, "_accept", around)


def goal(robot, change):
    """Set the goal of the wheels to `change(twist, asked)`; `asked` is the last twist that the driver requested."""
    gate, asked = robot.driving.gate, [STILL]
    wrap(gate, "_accept", lambda inner, *a: asked.__setitem__(0, a[1]) or inner(*a))

    def around(inner, now_us):
        twist = inner(now_us)
        return twist if twist == STILL else change(twist, asked[0])

    wrap(gate, "_goal", around)


def turned(twist, angular_rad_s):
    return Twist(linear_mps=twist.linear_mps, angular_rad_s=angular_rad_s)


@breaks("R-LIM-01")
def does_not_know_backwards(robot):
    goal(robot, lambda twist, _asked: Twist(linear_mps=abs(twist.linear_mps), angular_rad_s=twist.angular_rad_s))


@breaks("R-LIM-02")
def tells_no_limits(robot):
    bend_out(robot, "status", lambda _header, payload: payload.update(max_linear_mps=0.0, max_angular_rad_s=0.0))


@breaks("R-LIM-03")
def does_not_clamp(robot):
    goal(robot, lambda twist, asked: Twist(linear_mps=1.0, angular_rad_s=0.0) if asked.linear_mps > 40 else twist)


@breaks("R-LIM-04")
def does_not_clamp_turns(robot):
    goal(robot, lambda twist, asked: Twist(linear_mps=0.0, angular_rad_s=-5.0) if asked.angular_rad_s < -40 else twist)


@breaks("R-LIM-05")
def clamps_unsaid(robot):
    bend_out(robot, "status", lambda _header, payload: payload["refused"].pop(CLAMPED, None))


@breaks("R-LIM-06")
def clamps_each_axis_by_itself(robot):
    limits = robot.config.safety

    def change(twist, asked):
        linear_mps = max(-limits.max_linear_mps, min(limits.max_linear_mps, asked.linear_mps))
        return Twist(linear_mps=linear_mps, angular_rad_s=asked.angular_rad_s) if asked.linear_mps < 40 else twist

    def both(asked):
        return asked.linear_mps > 1 and asked.angular_rad_s > 1

    goal(robot, lambda twist, asked: change(twist, asked) if both(asked) else twist)


@breaks("R-LIM-07")
def no_ramp(robot):
    robot.driving.gate._ramp.step = lambda goal, elapsed_us: goal


# --- silence --------------------------------------------------------------------------------------------------------


@breaks("R-SIL-01")
def brakes_slowly(robot):
    gate, speed = robot.driving.gate, [0.0]

    def around(inner, goal, elapsed_us):
        twist = inner(goal, elapsed_us)
        if gate.state is State.HOLD and speed[0] > twist.linear_mps:
            linear_mps = max(twist.linear_mps, speed[0] - 0.3 * elapsed_us / 1e6)
            twist = Twist(linear_mps=linear_mps, angular_rad_s=twist.angular_rad_s)
        speed[0] = twist.linear_mps
        return twist

    wrap(gate._ramp, "step", around)


def revive(robot):
    """Restart the command in force at the current time."""
    gate = robot.driving.gate
    if gate._command is not None:
        gate._command = AcceptedCommand(gate._command.twist, robot.now(), robot.now(), gate._command.life_us,
                                        gate._command.cites_frame)


def revived_by(robot, reason):
    """Keep the wheels turning when the robot rejects a twist for `reason`."""

    def around(inner, source, error):
        if error.reason == reason:
            revive(robot)
        return inner(source, error)

    wrap(robot.driving.gate, "reject", around)


@breaks("R-SIL-02")
def refused_commands_keep_it_going(robot):
    revived_by(robot, "UNKNOWN_FRAME")


@breaks("R-SIL-03")
def anybodys_commands_keep_it_going(robot):
    revived_by(robot, "NOT_HOLDER")


@breaks("R-SIL-04", "R-SIL-13")
def judges_age_by_arrival(robot, sources=("vision", "teleop")):
    last = [None]

    def around(inner, message):
        echo = (fields_of(message.header) or {}).get("echo")
        before = robot.driving.gate.accepted
        inner(message)
        if robot.driving.gate.accepted > before and echo == last[0] and message.source in sources:
            revive(robot)
        last[0] = echo

    wrap(robot, "on_twist", around)


@breaks("R-SIL-13")
def judges_age_of_humans_by_arrival(robot):
    judges_age_by_arrival(robot, ("teleop",))


@breaks("R-SIL-05", "R-SIL-14")
def full_speed_on_ageing_sight(robot):
    gate = robot.driving.gate
    gate.config = gate.config.model_copy(update={"full_speed_age_ms": 399})


@breaks("R-SIL-14")
def turns_at_full_rate_on_ageing_sight(robot):
    most = robot.driving.gate.config.max_angular_rad_s
    goal(robot, lambda twist, asked: turned(twist, max(-most, min(most, asked.angular_rad_s))))


@breaks("R-SIL-06")
def hold_is_not_said(robot):
    def bend(_header, payload):
        if payload["state"] == "HOLD" and robot.driving.gate._lease.holder.source != "guest":
            payload["state"] = "DEGRADED"

    bend_out(robot, "status", bend)


@breaks("R-SIL-07")
def holds_for_ever(robot):
    gate = robot.driving.gate
    gate.config = gate.config.model_copy(update={"disarm_after_hold_s": 600.0})


@breaks("R-SIL-08")
def hold_is_the_end(robot):
    gate = robot.driving.gate

    def around(inner, source, header, twist, now_us):
        if gate.state is State.HOLD and now_us - gate._hold_since_us > 300_000 and source == "vision":
            return gate.reject(source, WireError(RejectReason.NOT_ALLOWED, "arm again"))
        return inner(source, header, twist, now_us)

    wrap(gate, "offer", around)


@breaks("R-SIL-09", "R-SIL-12")
def acks_keep_it_going(robot, sources=("vision", "teleop")):
    def around(inner, message):
        inner(message)
        who = who_sends(message)
        if who is not None and who == robot.driving.gate.holder(robot.now()) and who.source in sources:
            revive(robot)

    wrap(robot, "on_ack", around)


@breaks("R-SIL-12")
def acks_of_humans_keep_it_going(robot):
    acks_keep_it_going(robot, ("teleop",))


def rolls_on(robot, state, moves):
    """In `state` the wheels go on for two seconds if they move so."""
    gate, last, rolled_us = robot.driving.gate, [STILL], [0]

    def around(inner, goal, elapsed_us):
        twist = inner(goal, elapsed_us)
        rolled_us[0] = rolled_us[0] + elapsed_us if gate.state is state else 0
        if gate.state is state and moves(last[0]) and rolled_us[0] < 2_000_000:
            twist = last[0]
        last[0] = twist
        return twist

    wrap(gate._ramp, "step", around)


def backs(twist):
    return twist.linear_mps < 0 and twist.angular_rad_s == 0


def turns(twist):
    return twist.linear_mps == 0 and twist.angular_rad_s != 0


for _case, _state, _moves in (
    ("R-SIL-10", State.HOLD, backs), ("R-SIL-11", State.HOLD, turns),
    ("R-STOP-18", State.STOPPED, backs), ("R-STOP-19", State.STOPPED, turns),
    ("R-ARM-20", State.DISARMED, backs), ("R-ARM-21", State.DISARMED, turns),
):
    def _rolls_on(robot, state=_state, moves=_moves):
        rolls_on(robot, state, moves)

    _rolls_on.__name__ = f"{_moves.__name__}_on_in_{_state.value}"
    breaks(_case)(_rolls_on)


# --- measured motion -------------------------------------------------------------------------------------------------


@breaks("R-LIM-08")
def measures_a_third_of_its_motion(robot):
    def third(fields):
        fields.update(moving=[one * 0.3 for one in fields["moving"]], pose=[one * 0.3 for one in fields["pose"]])

    bend_out(robot, "odometry", lambda _header, payload: third(payload))
    bend_out(robot, "frame", lambda header, _payload: third(header))


LIARS = {}
"""`break_it(robot)` -> the cases that find it, all of which see the wheels alone. `status` reports a good robot."""


def lies(*case_ids):
    """Decorator: the wheels of this robot do what `bend(robot, asked)` gives, and `applied` hides it."""

    def add(bend):
        def break_it(robot):
            speeds = [(0.0, 0.0)]

            def around(inner, now_us, wheels, scan):
                speeds[0] = bend(robot, inner(now_us, wheels, scan), speeds[0])
                return speeds[0]

            wrap(robot.driving, "tick", around)

        break_it.__name__ = bend.__name__
        LIARS[break_it] = case_ids
        return break_it

    return add


@lies("R-STOP-01", "R-STOP-04", "R-STOP-06", "R-ARM-04", "R-ARM-05", "R-ARM-12", "R-LEASE-11", "R-LEASE-12", "R-SIL-01",
      "R-SIL-02", "R-SIL-03", "R-SIL-04", "R-SIL-07", "R-SIL-09")
def coasts(robot, asked, last):
    """The wheels never stop: the last speeds stay on the motors."""
    return asked if robot.driving.gate.state in (State.ACTIVE, State.DEGRADED) else last


@lies("R-LIM-08")
def swaps_the_axes(robot, asked, last):
    """Turns by the first number and drives by the second."""
    twist = twist_of(robot.config.wheels, *asked)
    return wheel_speeds(robot.config.wheels, Twist(linear_mps=twist.angular_rad_s, angular_rad_s=twist.linear_mps))


@lies("R-LIM-03", "R-LIM-04", "R-LIM-08")
def drives_twice_as_fast(robot, asked, last):
    return asked[0] * 2, asked[1] * 2


@lies("R-SIL-05")
def does_not_slow(robot, asked, last):
    full = robot.config.safety.max_linear_mps / robot.config.wheels.wheel_radius_m
    return (full, full) if robot.driving.gate.state in (State.DEGRADED, State.HOLD) else asked


@lies("R-CAUS-02", "R-CAUS-03", "R-CAUS-05", "R-CAUS-06", "R-CAUS-08", "R-CAUS-09")
def drives_by_rejected_twists(robot, asked, last):
    return (3.0, 3.0) if robot.driving.gate.state is State.DISARMED and robot.driving.gate.counters else asked
