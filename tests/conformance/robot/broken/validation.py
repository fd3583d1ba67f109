"""Robots that read or validate a twist wrongly: headers, grammar, causality, the sender's sequence. Pure."""

import json
import re

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import MAX_INTEGER
from sightline.protocol.transports.link import Message
from tests.conformance.robot.broken.breaking import as_json, bend_twists, breaks, fields_of, last_seq, wrap

HEX = re.compile(r"[0-9a-f]{8}")


def refuse(robot, message, reason="MALFORMED"):
    """Count a rejection that the reference does not make."""
    robot.driving.gate.reject(message.source, WireError(RejectReason(reason), "broken on purpose"))


def refuses(robot, wrong, reason="MALFORMED"):
    """Reject a twist for which `wrong(fields, message)` is true."""

    def around(inner, message):
        fields = fields_of(message.header)
        if fields is not None and wrong(fields, message):
            return refuse(robot, message, reason)
        return inner(message)

    wrap(robot, "on_twist", around)


def reads(robot, read_header=lambda header: header, read_payload=lambda payload: payload):
    """Read the bytes of a twist in another way, before the robot validates them."""

    def around(inner, message):
        parts = read_header(message.header), read_payload(message.payload)
        return inner(Message(message.channel, message.source, *parts))

    wrap(robot, "on_twist", around)


def newest(robot):
    """(seq, t_us) of the newest frame."""
    times = robot.driving.gate.issued._times.get("frame", {0: 0})
    seq = next(reversed(times))
    return seq, times[seq]


# --- headers ---------------------------------------------------------------------------------------------------------


@breaks("R-HEAD-01")
def refuses_unknown_fields(robot):
    known = {"v", "source", "session", "seq", "echo", "compute_us", "scan", "mission", "proof", "next_proof"}
    refuses(robot, lambda fields, message: set(fields) - known)


@breaks("R-HEAD-02")
def ignores_the_version(robot):
    bend_twists(robot, lambda fields, _message: type(fields.get("v")) is int and fields.update(v=1))


@breaks("R-HEAD-03")
def demands_the_version(robot):
    refuses(robot, lambda fields, message: fields and "v" not in fields)


@breaks("R-HEAD-04")
def makes_up_session_and_seq(robot):
    def fill(fields, _message):
        if fields:
            fields.setdefault("session", "00000000")
            fields.setdefault("seq", 1)

    bend_twists(robot, fill)


@breaks("R-HEAD-05")
def takes_the_newest_frame_where_none_is_cited(robot):
    def fill(fields, _message):
        if "session" in fields and "echo" not in fields:
            seq, t_us = newest(robot)
            fields["echo"] = {"channel": "frame", "session": robot.driving.session, "seq": seq, "t_us": t_us}

    bend_twists(robot, fill)


@breaks("R-HEAD-06")
def coerces_what_is_no_integer(robot):
    def coerce(fields, _message):
        if isinstance(fields.get("seq"), str | float) and not isinstance(fields.get("seq"), bool):
            fields["seq"] = int(float(fields["seq"])) if fields["seq"] == fields["seq"] else fields["seq"]

    bend_twists(robot, coerce)


@breaks("R-HEAD-07")
def integers_wrap_around(robot):
    def wrap_seq(fields, _message):
        if isinstance(fields.get("seq"), int) and fields["seq"] > MAX_INTEGER:
            fields["seq"] &= MAX_INTEGER

    bend_twists(robot, wrap_seq)


@breaks("R-HEAD-08")
def negative_computing_time(robot):
    def bend(fields, _message):
        if isinstance(fields.get("compute_us"), int):
            fields["compute_us"] = max(0, fields["compute_us"])

    bend_twists(robot, bend)


@breaks("R-HEAD-09")
def any_text_is_a_session(robot):
    def bend(fields, _message):
        session = fields.get("session")
        if isinstance(session, str) and session and not HEX.fullmatch(session):
            fields["session"] = f"{sum(session.encode()):08x}"

    bend_twists(robot, bend)


@breaks("R-HEAD-10")
def first_of_two_counts(robot):
    def first_wins(pairs):
        return dict(reversed(pairs))

    def read(header):
        try:
            fields = json.loads(header.decode(), object_pairs_hook=first_wins)
        except ValueError:
            return header
        return as_json(fields) if isinstance(fields, dict) else header

    reads(robot, read)


@breaks("R-HEAD-11")
def strips_a_byte_order_mark(robot):
    reads(robot, lambda header: header.removeprefix(b"\xef\xbb\xbf"))


@breaks("R-HEAD-12")
def ignores_what_follows_the_object(robot):
    def read(header):
        try:
            fields, _end = json.JSONDecoder().raw_decode(header.decode())
        except ValueError:
            return header
        return as_json(fields) if isinstance(fields, dict) else header

    reads(robot, read)


@breaks("R-HEAD-13")
def demands_the_computing_time(robot):
    refuses(robot, lambda fields, message: "echo" in fields and "compute_us" not in fields)


@breaks("R-HEAD-14")
def infinity_is_a_number(robot):
    def bend(fields, _message):
        if fields.get("compute_us") == float("inf"):
            fields["compute_us"] = MAX_INTEGER

    bend_twists(robot, bend)


@breaks("R-HEAD-15")
def reads_latin_1(robot):
    reads(robot, lambda header: header.decode("latin-1").encode() if header[:1] == b"{" else header)


@breaks("R-HEAD-16")
def nameless_twists_of_vision(robot):
    def around(inner, message):
        inner(message if message.header else Message(message.channel, "guest", b"", message.payload))

    wrap(robot, "on_twist", around)


@breaks("R-HEAD-17")
def believes_the_header(robot):
    def around(inner, message):
        fields = fields_of(message.header)
        known = fields is not None and fields.get("source") in ("vision", "teleop")
        inner(Message(message.channel, fields["source"], message.header, message.payload) if known else message)

    wrap(robot, "on_twist", around)


@breaks("R-HEAD-18")
def integers_of_32_bits(robot):
    def wrong(fields, _message):
        return isinstance(fields.get("compute_us"), int) and fields["compute_us"] >= 2**31

    refuses(robot, wrong)


# --- grammar ---------------------------------------------------------------------------------------------------------


@breaks("R-GRAM-01")
def no_exponents(robot):
    tenths = rb"(?!.*e-[0-9]{3})[0-9.|+-]+[eE]-[0-9][^e]*[eE]?-?[0-9]*"
    refuses(robot, lambda fields, message: re.fullmatch(tenths, message.payload))


@breaks("R-GRAM-02")
def reads_the_first_two(robot):
    reads(robot, read_payload=lambda payload: b"|".join(payload.split(b"|")[:2]))


@breaks("R-GRAM-03")
def strips_blanks(robot):
    reads(robot, read_payload=lambda payload: payload.strip())


@breaks("R-GRAM-04")
def nan_is_zero(robot):
    def read(payload):
        without = re.sub(rb"[+-]?nan", b"0", payload, flags=re.IGNORECASE)
        return without if re.fullmatch(rb"[0-9.]+[|][0-9.]+", without) else payload

    reads(robot, read_payload=read)


@breaks("R-GRAM-05")
def infinity_is_fast(robot):
    reads(robot, read_payload=lambda payload: re.sub(rb"inf(inity)?", b"99", payload, flags=re.IGNORECASE))


@breaks("R-GRAM-06")
def overflow_is_fast(robot):
    reads(robot, read_payload=lambda payload: re.sub(rb"e(999|308)", b"e30", payload))


@breaks("R-GRAM-07")
def reads_as_python_does(robot):
    reads(robot, read_payload=lambda payload: payload.replace(b"_", b""))


@breaks("R-GRAM-08")
def long_exponents(robot):
    reads(robot, read_payload=lambda payload: payload.replace(b"e0001", b"e1"))


@breaks("R-GRAM-09")
def a_comma_will_do(robot):
    reads(robot, read_payload=lambda payload: payload.replace(b",", b"|"))


@breaks("R-GRAM-10")
def drops_what_is_no_text_unsaid(robot):
    def around(inner, message):
        try:
            message.payload.decode()
        except UnicodeDecodeError:
            return
        inner(message)

    wrap(robot, "on_twist", around)


# --- causality -------------------------------------------------------------------------------------------------------


def bend_echo(robot, change):
    """`change(echo)` for every twist that has an echo with a session."""

    def bend(fields, _message):
        echo = fields.get("echo")
        if isinstance(echo, dict):
            change(echo)

    bend_twists(robot, bend)


@breaks("R-CAUS-01", "R-SEQ-15", "R-FLOW-20")
def learns_of_a_frame_too_late(robot):
    waiting = []
    wrap(robot, "issue", lambda _inner, header: waiting.append(header))

    def tick(inner, now_us):
        inner(now_us)
        while waiting and now_us - waiting[0].t_us >= 30_000:
            header = waiting.pop(0)
            robot.driving.on_issued(header.seq, header.t_us, 0)

    wrap(robot, "tick", tick)


@breaks("R-CAUS-02")
def any_seq_is_known(robot):
    def change(echo):
        if echo.get("seq") not in robot.driving.gate.issued._times.get("frame", {}) and echo["channel"] == "frame":
            echo["seq"], echo["t_us"] = newest(robot)

    bend_echo(robot, change)


@breaks("R-CAUS-03")
def about_the_right_time_will_do(robot):
    def change(echo):
        known_us = robot.driving.gate.issued._times.get("frame", {}).get(echo.get("seq"))
        if known_us is not None and abs(known_us - echo["t_us"]) < 1000:
            echo["t_us"] = known_us

    bend_echo(robot, change)


@breaks("R-CAUS-04")
def old_sight_will_do(robot):
    def change(echo):
        known_us = robot.driving.gate.issued._times.get("frame", {}).get(echo.get("seq"))
        if known_us == echo["t_us"] and robot.now() - known_us > 400_000:
            echo["seq"], echo["t_us"] = newest(robot)

    bend_echo(robot, change)


@breaks("R-CAUS-05")
def age_before_record(robot):
    def wrong(fields, _message):
        echo = fields.get("echo")
        return isinstance(echo, dict) and echo.get("t_us", 0) > robot.now() + 1_000_000

    refuses(robot, wrong, "FROM_FUTURE")


@breaks("R-CAUS-06")
def any_session_of_the_robot(robot):
    bend_echo(robot, lambda echo: echo.update(session=robot.driving.session) if echo["seq"] != "" else None)


@breaks("R-CAUS-07")
def a_status_will_do(robot):
    def change(echo):
        if echo.get("channel") == "status":
            seq, t_us = newest(robot)
            echo.update(channel="frame", seq=seq, t_us=t_us)

    bend_echo(robot, change)


@breaks("R-CAUS-08")
def a_beat_is_a_frame(robot):
    bend_echo(robot, lambda echo: echo.update(channel="frame") if echo.get("channel") == "beat" else None)


@breaks("R-CAUS-09")
def any_channel_is_a_frame(robot):
    bend_echo(robot, lambda echo: echo.update(channel="frame") if echo.get("channel") in ("camera", "") else None)


@breaks("R-CAUS-10")
def forgets_the_frame_before(robot):
    def wrong(fields, _message):
        echo = fields.get("echo")
        return isinstance(echo, dict) and newest(robot)[0] - 10 < echo.get("seq", 0) < newest(robot)[0]

    refuses(robot, wrong, "UNKNOWN_FRAME")


@breaks("R-CAUS-11")
def seq_before_session(robot):
    def wrong(fields, message):
        last = last_seq(robot, fields.get("source"), fields.get("session"))
        echo = fields.get("echo")
        foreign = isinstance(echo, dict) and echo.get("session") != robot.driving.session
        return foreign and isinstance(fields.get("seq"), int) and fields["seq"] <= last

    refuses(robot, wrong, "OUT_OF_ORDER")


# --- the sender's sequence -------------------------------------------------------------------------------------------


def check_seq(robot, check):
    """`check(inner, header, last)` in place of the reference's."""
    def around(inner, header, now_us):
        return check(lambda one: inner(one, now_us), header, last_seq(robot, header.source, header.session))

    wrap(robot.driving.gate._sequence, "check", around)


@breaks("R-SEQ-06")
def a_replay_will_do(robot):
    check_seq(robot, lambda inner, header, last: None if header.seq == last else inner(header))


@breaks("R-SEQ-07")
def only_the_same_is_a_replay(robot):
    def check(inner, header, last):
        if not last - 40 < header.seq < last:
            inner(header)

    check_seq(robot, check)


@breaks("R-SEQ-08", "R-SEQ-15")
def no_jumps(robot):
    def check(inner, header, last):
        if 0 <= last < header.seq - 500:
            raise WireError(RejectReason.OUT_OF_ORDER, "too far ahead")
        inner(header)

    check_seq(robot, check)


@breaks("R-SEQ-09")
def one_count_per_role(robot):
    highest = {}

    def check(inner, header, _last):
        if highest.get(header.source, 0) > 4096 and header.seq < highest[header.source]:
            raise WireError(RejectReason.OUT_OF_ORDER, "below what another session of this role has had")
        inner(header)
        highest[header.source] = max(highest.get(header.source, 0), header.seq)

    check_seq(robot, check)


@breaks("R-SEQ-10")
def remembers_seq_of_the_refused(robot):
    def bend(fields, _message):
        sender = fields.get("source"), fields.get("session")
        echo = fields.get("echo")
        unknown = isinstance(echo, dict) and echo.get("seq") not in robot.driving.gate.issued._times.get("frame", {})
        if unknown and last_seq(robot, *sender) >= 0:
            robot.driving.gate._sequence._drivers[sender] = fields["seq"], robot.now()

    bend_twists(robot, bend)
