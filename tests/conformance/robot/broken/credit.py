"""Robots that are wrong about credit, guests, hostile peers and reconnects. Pure."""

from sightline.protocol.channels import CHANNELS
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Twist
from sightline.protocol.proof import NO_PROOF
from sightline.protocol.transports.link import Message
from sightline.robot_side.ports import Picture
from sightline.robot_side.safety.lease import Lease
from sightline.robot_side.safety.validation import AcceptedCommand
from tests.conformance.robot.broken.breaking import as_json, bend_acks, bend_out, breaks, fields_of, wrap
from tests.conformance.robot.broken.lease import lease_of
from tests.fixtures.robot_process import JPEG


def stream_of(robot):
    return robot.sending._stream


def owns_too(robot, when):
    """Let any peer's answer return credit while `when(now_us)` is true."""
    wrap(stream_of(robot), "_owns", lambda inner, who, now_us: when(now_us) or inner(who, now_us))


@breaks("R-FLOW-01", "R-FLOW-17")
def sends_without_credit(robot):
    wrap(robot, "film", lambda _inner, now_us: robot.capture(Picture(JPEG, now_us)) if robot.listening() else None)


@breaks("R-FLOW-02")
def computing_widens_the_window(robot):
    stream = stream_of(robot)
    wrap(stream, "on_answer", lambda inner, who, seq, compute_us, now_us: inner(who, seq, 0, now_us))


@breaks("R-FLOW-03")
def acks_are_not_heard(robot):
    def around(inner, message):
        if "echo" not in (fields_of(message.header) or {}):
            inner(message)

    wrap(robot, "on_ack", around)


@breaks("R-FLOW-04")
def refused_twists_return_nothing(robot):
    gate = robot.driving.gate

    def around(inner, message):
        before = gate.counters["OUT_OF_ORDER"]
        ack = robot.driving.on_twist(message, robot.now())
        if ack is not None and gate.counters["OUT_OF_ORDER"] == before:
            robot.sending.on_command_ack(ack, robot.now())

    wrap(robot, "on_twist", around)


@breaks("R-FLOW-05")
def credit_is_out_for_long(robot):
    stream_of(robot)._timeout_us = lambda _now_us: 800_000


@breaks("R-FLOW-06")
def anybody_returns_credit(robot):
    owns_too(robot, lambda now_us: robot.driving.gate.holder(now_us) is not None)


@breaks("R-FLOW-07")
def window_is_always_one(robot):
    stream = stream_of(robot)
    stream.__class__ = type("Narrow", (type(stream),), {"window": 1})


@breaks("R-FLOW-08")
def only_the_cited_frame_counts(robot):
    stream = stream_of(robot)

    def around(inner, who, seq, compute_us, now_us):
        kept = {old: at_us for old, at_us in stream._in_flight.items() if old < seq}
        result = inner(who, seq, compute_us, now_us)
        stream._in_flight.update(kept)
        return result

    wrap(stream, "on_answer", around)


@breaks("R-FLOW-09")
def acks_of_another_session(robot):
    def bend(fields, _message):
        if isinstance(fields.get("echo"), dict):
            fields["echo"]["session"] = robot.driving.session

    bend_acks(robot, bend)


@breaks("R-FLOW-10")
def acks_of_frames_to_come(robot):
    def bend(fields, _message):
        echo = fields.get("echo")
        if isinstance(echo, dict) and echo["seq"] >= robot.sending._seq:
            echo["seq"], echo["t_us"] = next(reversed(robot.sending._frame_times.items()))

    bend_acks(robot, bend)


@breaks("R-FLOW-11")
def keeps_a_picture_for_later(robot):
    kept = [None]

    def film(_inner, now_us):
        if robot.sending.may_capture(now_us, robot.listening()):
            old, kept[0] = kept[0], Picture(JPEG, now_us)
            robot.capture(old or kept[0])
            kept[0] = None if old is None else kept[0]
        elif kept[0] is None or now_us - kept[0].t_us > 250_000:
            kept[0] = Picture(JPEG, now_us)

    wrap(robot, "film", film)


# --- guests ----------------------------------------------------------------------------------------------------------


def on_bare(robot, change):
    """`change(inner, message)` for a guest's twist without header."""

    def around(inner, message):
        return change(inner, message) if message.source == "guest" and not message.header else inner(message)

    wrap(robot, "on_twist", around)


@breaks("R-DIAL-01")
def a_guest_needs_a_header(robot):
    gate = robot.driving.gate
    on_bare(robot, lambda _inner, message: gate.reject("guest", WireError(RejectReason.MALFORMED, "no header")))


@breaks("R-DIAL-02", "R-DIAL-10")
def guests_drive_fast(robot):
    gate = robot.driving.gate
    gate.config = gate.config.model_copy(update={"guest_max_linear_mps": 0.5, "guest_max_angular_rad_s": 2.0})


@breaks("R-DIAL-09")
def guests_are_never_armed(robot):
    gate = robot.driving.gate

    def missing(inner, now_us):
        holder = gate.holder(now_us)
        return "guests may not" if holder and holder.source == "guest" else inner(now_us)

    wrap(gate, "_missing_to_arm", missing)


@breaks("R-DIAL-10")
def guests_with_a_header_drive_fast(robot):
    def around(inner, source, twist, now_us, age_us):
        inner(source if age_us is None else "vision", twist, now_us, age_us)

    wrap(robot.driving.gate, "_accept", around)


@breaks("R-DIAL-03")
def guests_do_not_yield(robot):
    def may_take(self, who, now_us, proof=NO_PROOF):
        holder = self.live_holder(now_us)
        if holder is not None and holder.source == "guest" and who.source == "vision":
            return False
        return Lease.may_take(self, who, now_us, proof)

    lease_of(robot, may_take=may_take)


@breaks("R-DIAL-04")
def guests_headers_are_not_read(robot):
    def around(inner, message):
        inner(Message(message.channel, message.source, b"", message.payload) if message.source == "guest" else message)

    wrap(robot, "on_twist", around)


@breaks("R-DIAL-05")
def guests_live_long(robot):
    gate = robot.driving.gate

    def around(inner, source, twist, now_us, age_us):
        inner(source, twist, now_us, age_us)
        if source == "guest":
            gate._command = AcceptedCommand(gate._command.twist, now_us + 60_000_000, now_us, 60_000_000, False)

    wrap(gate, "_accept", around)


@breaks("R-DIAL-07")
def guests_repeat_one_twist_for_ever(robot):
    robot.driving.gate._repeats_too_long = lambda _command, _now_us: False


@breaks("R-DIAL-08")
def guests_have_the_age_of_their_twist(robot):
    gate = robot.driving.gate

    def bend(_header, payload):
        if gate._command is not None and not gate._command.cites_frame:
            payload["frame_age_us"] = robot.now() - gate._command.arrival_us

    bend_out(robot, "status", bend)


# --- roles and keys --------------------------------------------------------------------------------------------------


@breaks("R-HOST-01")
def watchers_drive(robot):
    def around(inner, message):
        fields = fields_of(message.header)
        if message.source == "viewer" and fields is not None:
            message = Message(message.channel, "vision", as_json({**fields, "source": "vision"}), message.payload)
        inner(message)

    wrap(robot, "on_twist", around)


def hears_raw(robot, is_taken, change=lambda header, payload: (header, payload)):
    """Raw messages for which `is_taken(key, header, payload)` are twists of vision."""
    link, twist = robot.link, CHANNELS["twist"]
    wrap(link, "subscribes_to", lambda inner, key: inner(key) or is_taken(key, b"", b""))

    def receive(inner, key, header, payload):
        if is_taken(key, header, payload):
            robot.receive(Message(twist, "vision", *change(header, payload)))
        else:
            inner(key, header, payload)

    wrap(link, "receive", receive)


@breaks("R-HOST-02")
def hears_wildcards(robot):
    hears_raw(robot, lambda key, _header, _payload: "*" in key)


@breaks("R-HOST-03")
def hears_what_is_for_others(robot):
    hears_raw(robot, lambda key, _header, _payload: key.startswith("sightline/other/twist") or key.endswith("/more"))


@breaks("R-HOST-04")
def reads_long_twists(robot):
    hears_raw(
        robot, lambda key, _header, payload: "/twist/vision" in key and len(payload) > 64,
        lambda header, payload: (header, payload.replace(b"0" * 40, b"")),
    )  # fmt: skip


@breaks("R-HOST-05")
def reads_long_headers(robot):
    hears_raw(
        robot, lambda key, header, _payload: "/twist/vision" in key and len(header) > 512,
        lambda header, payload: (header.replace(b"x" * 300, b""), payload),
    )  # fmt: skip


# --- nonsense and floods ---------------------------------------------------------------------------------------------


def dies_of(robot, is_deadly):
    """One message for which `is_deadly(header, payload)` ends it for three seconds, as a crash and a restart do."""
    dead_until_us = [0]

    def receive(inner, message):
        if is_deadly(message.header, message.payload):
            dead_until_us[0] = robot.now() + 3_000_000
        elif robot.now() >= dead_until_us[0]:
            inner(message)

    receiving = robot.receive
    robot.link._callbacks.clear()
    robot.receive = lambda message: receive(receiving, message)
    robot.hook()
    wrap(robot, "tick", lambda inner, now_us: inner(now_us) if now_us >= dead_until_us[0] else None)


@breaks("R-HOST-06")
def dies_of_noise(robot):
    dies_of(robot, lambda header, _payload: header[:1] == b"\0" or header[:1] >= b"\xf0")


@breaks("R-HOST-07")
def dies_of_depth(robot):
    dies_of(robot, lambda header, _payload: header.count(b"[") > 100 or header.count(b"{") > 50)


@breaks("R-HOST-08")
def dies_of_surrogates(robot):
    dies_of(robot, lambda header, _payload: b"\\ud" in header)


@breaks("R-HOST-09")
def drowns(robot):
    received_us = []

    def around(inner, message):
        received_us.append(robot.now())
        del received_us[:-200]
        if len(received_us) < 200 or received_us[-1] - received_us[0] > 1_000_000:
            inner(message)

    wrap(robot, "on_twist", around)


@breaks("R-HOST-10")
def forgets_who_drives_when_many_come(robot):
    record = robot.driving.gate._sequence

    def around(inner, *arguments):
        if len(record._others) > 60:
            robot.driving.gate._lease.drop()
        inner(*arguments)

    wrap(record, "check", around)


# --- coming and going ------------------------------------------------------------------------------------------------


def on_return(robot, call, every_tick=lambda away: None):
    """`call()` when a peer is connected again after none was."""
    away = [False]

    def tick(inner, now_us):
        if away[0] and robot.link.connected:
            call()
        away[0] = not robot.link.connected
        every_tick(away[0])
        inner(now_us)

    wrap(robot, "tick", tick)


@breaks("R-RECO-01")
def serves_frames_once(robot):
    on_return(robot, lambda: setattr(robot, "listening", lambda: False))


@breaks("R-RECO-02")
def begins_a_session_with_each_peer(robot):
    sessions = [robot.driving.session]
    on_return(robot, lambda: sessions.append("0000cafe"))
    bend_out(robot, "status", lambda header, _payload: header.update(session=sessions[-1]))


@breaks("R-RECO-03")
def goes_on_where_it_was(robot):
    gate = robot.driving.gate

    def resume():
        now_us = robot.now()
        gate._command = AcceptedCommand(
            Twist(linear_mps=0.2, angular_rad_s=0.0), now_us + 300_000, now_us + 300_000, 500_000, True
        )

    on_return(robot, resume)


@breaks("R-RECO-04")
def lease_ends_with_the_connection(robot):
    on_return(robot, robot.driving.gate._lease.drop)
