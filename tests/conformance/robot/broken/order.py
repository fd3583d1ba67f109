"""Robots that validate in another order, remember too little, or read a value at a bound wrongly. Pure."""

import re

from sightline.protocol.channels import ACK, REPLY
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import MAX_INTEGER, Reply, State, Verb
from sightline.protocol.proof import session_digest
from sightline.protocol.transports.link import Message
from tests.conformance.robot.broken.arming import absent, forgives
from tests.conformance.robot.broken.breaking import bend_acks, bend_out, bend_twists, breaks, fields_of, last_seq, wrap
from tests.conformance.robot.broken.credit import owns_too, stream_of
from tests.conformance.robot.broken.validation import refuse, refuses


def record_of(robot):
    """The newest seq of each sender."""
    return robot.driving.gate._sequence


def echo_of(fields):
    """The echo, or an empty one."""
    echo = (fields or {}).get("echo")
    return echo if isinstance(echo, dict) else {}


# --- headers and grammar ---------------------------------------------------------------------------------------------


@breaks("R-HEAD-19")
def coerces_the_version(robot):
    bend_twists(robot, lambda fields, _message: fields.get("v") == "1" and fields.update(v=1))


@breaks("R-HEAD-20")
def whole_reals_are_integers(robot):
    def bend(fields, _message):
        value = fields.get("compute_us")
        if isinstance(value, float) and value.is_integer():
            fields["compute_us"] = int(value)

    bend_twists(robot, bend)


@breaks("R-HEAD-21")
def headers_of_400_bytes(robot):
    refuses(robot, lambda _fields, message: len(message.header) > 400)


@breaks("R-HEAD-22")
def answers_go_by_nothing(robot):
    refuses(robot, lambda fields, _message: "scan" in fields or "mission" in fields)


@breaks("R-HEAD-23")
def missions_are_not_read(robot):
    bend_twists(robot, lambda fields, _message: fields.update(mission=None))


@breaks("R-GRAM-11")
def underflow_is_no_number(robot):
    refuses(robot, lambda _fields, message: re.search(rb"e-[0-9]{3}", message.payload), "NOT_FINITE")


@breaks("R-GRAM-12")
def both_fields_must_be_words(robot):
    refuses(robot, lambda _fields, message: re.fullmatch(rb"(?i)nan[|]x|x[|]-nan", message.payload))


@breaks("R-GRAM-13")
def whatever_begins_with_nan(robot):
    refuses(robot, lambda _fields, message: message.payload.startswith(b"nans"), "NOT_FINITE")


@breaks("R-GRAM-14")
def twists_of_48_bytes(robot):
    refuses(robot, lambda _fields, message: len(message.payload) > 48)


# --- the order -------------------------------------------------------------------------------------------------------


@breaks("R-CAUS-12")
def role_before_grammar(robot):
    refuses(robot, lambda _fields, message: message.source == "viewer", "UNKNOWN_SOURCE")


@breaks("R-CAUS-13")
def session_before_role(robot):
    def wrong(fields, message):
        return message.source == "viewer" and echo_of(fields).get("session") != robot.driving.session

    refuses(robot, wrong, "OTHER_SESSION")


@breaks("R-CAUS-14")
def count_before_record(robot):
    def wrong(fields, _message):
        last = last_seq(robot, fields.get("source"), fields.get("session"))
        seq, echo = fields.get("seq"), echo_of(fields)
        replayed = isinstance(seq, int) and seq <= last
        return replayed and echo.get("session") == robot.driving.session and echo.get("seq") == MAX_INTEGER

    refuses(robot, wrong, "OUT_OF_ORDER")


@breaks("R-CAUS-15")
def one_twist_for_a_frame(robot):
    answered = {}

    def around(inner, message):
        fields = fields_of(message.header)
        who, echo = (message.source, (fields or {}).get("session")), echo_of(fields)
        cited = echo.get("channel"), echo.get("seq")
        if echo and answered.get(who) == cited and robot.driving.gate.state is State.DISARMED:
            return refuse(robot, message, "OUT_OF_ORDER")
        judged = inner(message)
        if robot.driving.gate.holder(robot.now()) is not None:
            answered[who] = cited
        return judged

    wrap(robot, "on_twist", around)


@breaks("R-CAUS-16")
def remembers_fifty_frames(robot):
    def around(inner, channel, seq, t_us):
        inner(channel, seq, t_us)
        times = robot.driving.gate.issued._times[channel]
        while channel == "frame" and len(times) > 50:
            times.popitem(last=False)

    wrap(robot.driving.gate.issued, "add", around)


@breaks("R-SEQ-11")
def refused_for_the_lease_uses_nothing_up(robot):
    others = record_of(robot)._others

    def around(inner, source, header, *arguments):
        verdict = inner(source, header, *arguments)
        if verdict.reason is RejectReason.NOT_HOLDER:
            others.pop((source, header.session if header else ""), None)
        return verdict

    wrap(robot.driving.gate, "offer", around)


@breaks("R-SEQ-12")
def one_memory_for_all_senders(robot):
    record = record_of(robot)

    def around(inner, *arguments):
        inner(*arguments)
        if len(record._others) > 63:
            record._drivers.clear()

    wrap(record, "check", around)


@breaks("R-SEQ-15")
def smaller_leaps(robot):
    refuses(robot, lambda fields, _message: fields.get("seq") == (1 << 32) + (1 << 20), "OUT_OF_ORDER")


@breaks("R-SEQ-16")
def remembers_three_seconds(robot):
    record = record_of(robot)

    def around(inner, header, now_us):
        for sender, (_seq, received_us) in list(record._drivers.items()):
            if now_us - received_us > 3_000_000:
                del record._drivers[sender]
        inner(header, now_us)

    wrap(record, "check", around)


@breaks("R-SEQ-13")
def any_next_seq_will_do(robot):
    forgives_seq(robot, 1 << 52, lambda last: last >= 0)


@breaks("R-SEQ-17")
def humans_need_not_count(robot):
    record = record_of(robot)
    wrap(record, "check", lambda inner, header, now_us: None if header.source == "teleop" else inner(header, now_us))


@breaks("R-CAUS-17")
def humans_cite_the_newest_frame(robot):
    issued = robot.driving.gate.issued

    def change(fields, message):
        if message.source == "teleop" and isinstance(fields.get("echo"), dict):
            seq, t_us = next(reversed(issued._times["frame"].items()))
            fields["echo"].update(seq=seq, t_us=t_us)

    bend_twists(robot, change)


@breaks("R-SEQ-14")
def any_first_seq_will_do(robot):
    forgives_seq(robot, 1 << 52, lambda last: last < 0)


def forgives_seq(robot, seq, when):
    """Takes `seq` as the next one."""

    def around(inner, header, now_us):
        if header.seq == seq and when(last_seq(robot, header.source, header.session)):
            return None
        return inner(header, now_us)

    wrap(record_of(robot), "check", around)


# --- arming and the lease --------------------------------------------------------------------------------------------


@breaks("R-ARM-13")
def a_refusal_breaks_the_row(robot):
    gate = robot.driving.gate
    wrap(gate, "reject", lambda inner, source, error: _begin_row(gate, error) or inner(source, error))


def _begin_row(gate, error):
    if error.reason is RejectReason.MALFORMED:
        gate._live_commands = 0


@breaks("R-ARM-14")
def rows_outlast_the_lease(robot):
    gate, last, count = robot.driving.gate, [None], [0]

    def around(inner, *arguments):
        before = gate._lease.expires_us
        verdict = inner(*arguments)
        if gate._lease.expires_us > before:
            count[0] = count[0] + 1 if gate._lease.holder == last[0] else 1
            gate._live_commands, last[0] = count[0], gate._lease.holder
        return verdict

    wrap(gate, "offer", around)


@breaks("R-LEASE-19")
def release_needs_the_lease(robot):
    def around(inner, who, now_us):
        detail = inner(who, now_us)
        if detail == "not held":
            raise WireError(RejectReason.NOT_HOLDER, detail)
        return detail

    wrap(robot.driving.gate, "release", around)


@breaks("R-LEASE-20")
def acquires_without_echo(robot):
    forgives(robot, Verb.ACQUIRE, absent)


@breaks("R-DIAL-06")
def guests_are_many(robot):
    def bend(_header, payload):
        if (payload.get("holder") or {}).get("source") == "guest":
            payload["holder"]["digest"] = "0000beef"

    bend_out(robot, "status", bend)


# --- credit ----------------------------------------------------------------------------------------------------------


def returns_credit_for(robot, reason):
    """Take a twist that is rejected for this reason as an ack."""

    def around(inner, message):
        before = robot.driving.gate.counters[reason]
        inner(message)
        if robot.driving.gate.counters[reason] > before and "echo" in (fields_of(message.header) or {}):
            robot.on_ack(Message(ACK, message.source, message.header, b""))

    wrap(robot, "on_twist", around)


@breaks("R-FLOW-12")
def malformed_twists_return_credit(robot):
    returns_credit_for(robot, "MALFORMED")


@breaks("R-FLOW-17")
def twists_that_are_not_proven_return_credit(robot):
    returns_credit_for(robot, "NOT_PROVEN")


@breaks("R-FLOW-13")
def credit_is_everybodys_while_nobody_drives(robot):
    owns_too(robot, lambda now_us: robot.driving.gate.holder(now_us) is None)


@breaks("R-FLOW-14")
def owns_credit_for_long(robot):
    stream = stream_of(robot)
    stream._config = stream._config.model_copy(update={"owner_life_ms": 10_000})


@breaks("R-FLOW-15")
def acks_in_order_only(robot):
    newest = {}

    def around(inner, message):
        fields = fields_of(message.header) or {}
        seq = fields.get("seq")
        if isinstance(seq, int) and seq <= newest.get(fields.get("session"), -1):
            return
        newest[fields.get("session")] = seq
        inner(message)

    wrap(robot, "on_ack", around)


@breaks("R-FLOW-18")
def acks_of_any_time(robot):
    def bend(fields, _message):
        echo = echo_of(fields)
        echo["t_us"] = robot.sending._frame_times.get(echo.get("seq"), echo.get("t_us"))

    bend_acks(robot, bend)


@breaks("R-FLOW-19")
def acks_of_any_source(robot):
    def around(inner, message):
        source = (fields_of(message.header) or {}).get("source")
        inner(Message(message.channel, source or message.source, message.header, message.payload))

    wrap(robot, "on_ack", around)


@breaks("R-FLOW-20")
def stopped_twists_return_no_credit(robot):
    def around(inner, message, now_us):
        ack = inner(message, now_us)
        return None if robot.driving.gate.state is State.STOPPED else ack

    wrap(robot.driving, "on_twist", around)


# --- requests and status ---------------------------------------------------------------------------------------------


@breaks("R-REQ-12")
def answers_what_it_cannot_read(robot):
    def around(inner, message):
        inner(message)
        if isinstance((fields_of(message.payload) or {}).get("id"), str):
            header = fields_of(message.header)
            to = session_digest(header["source"], header["session"])
            reply = Reply(to=to, id=0, ok=False, state=robot.driving.gate.state, detail="MALFORMED: id is not a number")
            robot.driving._post(REPLY, reply, robot.now())

    wrap(robot, "on_request", around)


@breaks("R-REQ-13")
def any_status_will_do(robot):
    issued = robot.driving.gate.issued

    def unknown(echo, _now_us):
        ours = echo is not None and (echo.channel, echo.session) == ("status", issued.session)
        return ours and echo.seq > issued.last_seq("status")

    forgives(robot, Verb.RESET, unknown)


@breaks("R-REQ-14")
def a_frame_is_as_good_as_a_status(robot):
    forgives(robot, Verb.RESET, lambda echo, _now_us: echo is not None and echo.channel == "frame")


@breaks("R-STAT-10")
def drops_acks_unsaid(robot):
    def around(inner, message):
        if isinstance((fields_of(message.header) or {}).get("seq"), int):
            inner(message)

    wrap(robot, "on_ack", around)


@breaks("R-STAT-11")
def counts_anew_after_reset(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us):
        if gate.state is State.STOPPED:
            gate.counters.clear()
        return inner(who, now_us)

    wrap(gate, "reset", around)


@breaks("R-FLOW-16")
def films_for_nobody(robot):
    robot.listening = lambda: True
