"""Robots that read, grant or answer requests wrongly. Pure."""

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Verb
from sightline.protocol.transports.link import Message
from tests.conformance.robot.broken.breaking import as_json, bend_out, bend_requests, breaks, fields_of, wrap


@breaks("R-REQ-01")
def replies_twice(robot):
    def around(inner, message):
        inner(message)
        if message.channel.name == "reply":
            header = {**fields_of(message.header), "seq": fields_of(message.header)["seq"] + 1_000_000}
            robot.send(message.channel, repr(header).replace("'", '"').encode(), message.payload)

    wrap(robot, "emit", around)


@breaks("R-REQ-02")
def reply_has_its_own_id(robot):
    bend_out(robot, "reply", lambda header, payload: payload.update(id=header["seq"]))


@breaks("R-REQ-03")
def reply_shows_the_session(robot):
    def around(inner, message):
        robot.asker = (fields_of(message.header) or {}).get("session")
        inner(message)

    wrap(robot, "on_request", around)
    bend_out(robot, "reply", lambda _header, payload: payload.update(to=robot.asker))


@breaks("R-REQ-04")
def silent_on_what_it_has_answered(robot):
    answered = set()

    def around(inner, message):
        fields, payload = fields_of(message.header), fields_of(message.payload)
        name = (fields or {}).get("session"), (payload or {}).get("id")
        if name not in answered or name[1] is None:
            answered.add(name)
            inner(message)

    wrap(robot, "on_request", around)


@breaks("R-REQ-05")
def any_other_verb_disarms(robot):
    verbs = {verb.value for verb in Verb}
    bend_requests(robot, lambda _header, payload: payload.get("verb") in verbs or payload.update(verb="disarm"))


@breaks("R-REQ-06")
def requests_believe_the_key(robot):
    def around(inner, message):
        fields = fields_of(message.header)
        if message.source == "teleop" and (fields or {}).get("source") == "operator":
            header = as_json({**fields, "source": "teleop"})
            message = Message(message.channel, message.source, header, message.payload)
        inner(message)

    wrap(robot, "on_request", around)


@breaks("R-REQ-07")
def reply_tells_the_state_before(robot):
    state = [robot.driving.gate.state]
    wrap(robot, "on_request", lambda inner, message: state.__setitem__(0, robot.driving.gate.state) or inner(message))
    bend_out(robot, "reply", lambda _header, payload: payload.update(state=state[0].value))


@breaks("R-REQ-08")
def nameless_requests(robot):
    header = b'{"v":1,"source":"operator","session":"00000000","seq":1}'

    def around(inner, message):
        inner(message if message.header else type(message)(message.channel, message.source, header, message.payload))

    wrap(robot, "on_request", around)


@breaks("R-REQ-09")
def requests_of_known_fields_only(robot):
    def around(inner, message):
        if b'"colour"' in message.payload or b'"mood"' in message.header:
            robot.driving.gate.reject(message.source, WireError(RejectReason.MALFORMED, "unknown field"))
        else:
            inner(message)

    wrap(robot, "on_request", around)


@breaks("R-REQ-10")
def refuses_without_a_word(robot):
    bend_out(robot, "reply", lambda _header, payload: payload.update(detail="" if not payload["ok"] else "done"))


@breaks("R-REQ-11")
def resets_of_another_session(robot):
    def bend(header, payload):
        if payload.get("verb") == "reset" and "echo" in header:
            header["echo"]["session"] = robot.driving.session

    bend_requests(robot, bend)


@breaks("R-REQ-15")
def requests_in_order_only(robot):
    newest = {}

    def around(inner, header, request, now_us):
        if header.seq < newest.get(header.session, 0):
            raise WireError(RejectReason.OUT_OF_ORDER, "below the last")
        newest[header.session] = header.seq
        return inner(header, request, now_us)

    wrap(robot.driving.gate, "request", around)
