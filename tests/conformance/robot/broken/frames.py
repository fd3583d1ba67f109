"""Robots that publish something wrong: framing, their own sequence, status. Pure."""

import struct

from tests.conformance.robot.broken.breaking import as_json, bend_acks, bend_out, bend_twists, breaks, fields_of, wrap

EVERY = 25
"""One frame of so many is wrong: enough to be found in two seconds, too few to disturb other cases."""
_NOT_ANSWERED = 23
"""In place of EVERY: the one frame that R-FLOW-08 answers is right then."""


def every(robot, name, change, number=17):
    """`change(message)` gives (header, payload) for one message of EVERY on channel `name`."""
    seen = [0]

    def around(inner, message):
        seen[0] += message.channel.name == name
        if message.channel.name != name or seen[0] % EVERY != number:
            return inner(message)
        robot.send(message.channel, *change(message))
        return None

    wrap(robot, "emit", around)


def while_only_watched(robot, name, period, change):
    """`change(fields)` on every `period`th message of `name`, until the first command or request."""
    seen = [0]

    def bend(header, _payload):
        seen[0] += 1
        if seen[0] % period == period - 1 and not robot.driving.gate.counters and robot.driving.gate.holder(0) is None:
            change(header)

    bend_out(robot, name, bend)


def header_with(**changes):
    return lambda message: (as_json({**fields_of(message.header), **changes}), message.payload)


@breaks("R-FRAM-01")
def header_lacks_its_time(robot):
    every(robot, "frame", header_with(t_us=None))


@breaks("R-FRAM-02")
def a_png_among_the_pictures(robot):
    every(robot, "frame", lambda message: (message.header, b"\x89PNG\r\n\x1a\n" + message.payload))


@breaks("R-FRAM-03")
def camera_has_a_session_of_its_own(robot):
    bend_out(robot, "camera", lambda header, _payload: header.update(session="0000beef"))


@breaks("R-FRAM-04")
def talkative_headers(robot):
    bend_out(robot, "frame", lambda header, _payload: header.update(note="x" * 200))


@breaks("R-FRAM-05")
def header_over_512_bytes(robot):
    every(robot, "frame", header_with(note="x" * 500))


@breaks("R-FRAM-06")
def publishes_under_a_wildcard(robot):
    def around(inner, message):
        inner(message)
        if message.channel.name == "odometry":
            robot.send(message.channel, message.header, message.payload, key="sightline/**")

    wrap(robot, "emit", around)


def one_of(robot, name, share):
    """Publish one of `share` messages of `name`."""
    seen = [0]

    def around(inner, message):
        seen[0] += message.channel.name == name
        if message.channel.name != name or seen[0] % share == 1:
            inner(message)

    wrap(robot, "emit", around)


@breaks("R-FRAM-07")
def camera_model_is_rare(robot):
    one_of(robot, "camera", 3)


@breaks("R-FRAM-08")
def camera_model_is_of_another_size(robot):
    bend_out(robot, "camera", lambda _header, payload: payload.update(width_px=640, height_px=480))


@breaks("R-FRAM-09")
def status_is_slow(robot):
    seen = [0]

    def around(inner, message):
        seen[0] += message.channel.name == "status"
        if message.channel.name != "status" or seen[0] % 3:
            inner(message)

    wrap(robot, "emit", around)


@breaks("R-FRAM-10")
def odometry_is_slow(robot):
    one_of(robot, "odometry", 4)


@breaks("R-FRAM-11")
def scan_holds_a_nan(robot):
    def around(inner, message):
        if message.channel.name == "scan":
            robot.send(message.channel, message.header, struct.pack("<f", float("nan")) + message.payload[4:])
        else:
            inner(message)

    wrap(robot, "emit", around)


@breaks("R-FRAM-12")
def frames_say_nothing_is_applied(robot):
    bend_out(robot, "frame", lambda header, _payload: header.update(applied=[0.0, 0.0]))


@breaks("R-FRAM-13")
def frames_have_one_latency(robot):
    bend_out(robot, "frame", lambda header, _payload: header.update(latency_us=50_000))


# --- sequence --------------------------------------------------------------------------------------------------------


@breaks("R-SEQ-01")
def frame_seq_repeats(robot):
    while_only_watched(robot, "frame", _NOT_ANSWERED, lambda header: header.update(seq=header["seq"] - 1))


@breaks("R-SEQ-02")
def capture_time_goes_back(robot):
    while_only_watched(robot, "frame", _NOT_ANSWERED, lambda header: header.update(t_us=header["t_us"] - 300_000))


@breaks("R-SEQ-03")
def status_seq_repeats(robot):
    while_only_watched(robot, "status", 12, lambda header: header.update(seq=header["seq"] - 1))


@breaks("R-SEQ-04")
def odometry_does_not_count(robot):
    bend_out(robot, "odometry", lambda header, _payload: header.update(seq=0))


@breaks("R-SEQ-05", "R-LEASE-31")
def frames_have_a_clock_of_their_own(robot):
    bend_out(robot, "frame", lambda header, _payload: header.update(t_us=header["t_us"] + 10_000_000))

    def back(fields, _message):
        echo = fields.get("echo")
        if isinstance(echo, dict) and echo.get("channel") == "frame" and isinstance(echo.get("t_us"), int):
            echo["t_us"] -= 10_000_000

    bend_twists(robot, back)
    bend_acks(robot, back)


# --- status ----------------------------------------------------------------------------------------------------------


@breaks("R-STAT-01")
def counts_only_to_three(robot):
    def bend(_header, payload):
        if payload["refused"].get("UNKNOWN_FRAME", 0) > 3:
            payload["refused"]["UNKNOWN_FRAME"] = 3

    bend_out(robot, "status", bend)


@breaks("R-STAT-02")
def refusal_names_nobody(robot):
    def bend(_header, payload):
        if payload.get("last_refusal"):
            payload["last_refusal"]["source"] = ""

    bend_out(robot, "status", bend)


@breaks("R-STAT-13")
def reason_has_two_lines(robot):
    bend_out(robot, "status", lambda _header, payload: payload.update(reason=payload["reason"] + "\n(see the log)"))


@breaks("R-STAT-03")
def counts_refused_as_accepted(robot):
    def around(inner, source, error):
        robot.driving.gate.accepted += error.reason == "MALFORMED" and robot.driving.gate.accepted > 0
        return inner(source, error)

    wrap(robot.driving.gate, "reject", around)


@breaks("R-STAT-04")
def tells_no_frame_age(robot):
    bend_out(robot, "status", lambda _header, payload: payload.pop("frame_age_us", None))


@breaks("R-STAT-05")
def latency_is_always_zero(robot):
    bend_out(robot, "status", lambda _header, payload: payload.update(latency_us=0))


@breaks("R-STAT-06")
def sent_stays_at_zero(robot):
    bend_out(robot, "status", lambda _header, payload: payload["stream"].update(sent=0))


@breaks("R-STAT-12")
def rate_is_a_wish(robot):
    bend_out(robot, "status", lambda _header, payload: payload["stream"].update(fps=0.0))


@breaks("R-STAT-07")
def reason_never_changes(robot):
    bend_out(robot, "status", lambda _header, payload: payload.update(reason="ok"))


@breaks("R-STAT-08", "R-DIAL-10")
def status_says_nothing_is_applied(robot):
    bend_out(robot, "status", lambda _header, payload: payload.update(applied=[0.0, 0.0]))


@breaks("R-STAT-09")
def holder_sticks(robot):
    last = [None]

    def bend(_header, payload):
        last[0] = payload.get("holder") or last[0]
        if last[0]:
            payload["holder"] = last[0]

    bend_out(robot, "status", bend)
