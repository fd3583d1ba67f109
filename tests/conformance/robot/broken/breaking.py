"""Mutations that break a robot on purpose: a table from case to mutation, and ways to bend input and output. Pure."""

import json

from sightline.protocol.transports.link import Message

BROKEN = {}
"""Case id -> `break_it(robot)`, whose name shows what is wrong. Exactly that case must fail."""


def breaks(case_id, *also):
    """Decorator: this mutation is what `case_id` finds; the cases `also` build on what it breaks."""

    def add(break_it):
        assert case_id not in BROKEN, case_id
        BROKEN[case_id], break_it.also = break_it, also
        return break_it

    return add


def last_seq(robot, source, session):
    """The newest seq of one sender, -1 before its first."""
    record, sender = robot.driving.gate._sequence, (source, session)
    return (record._drivers.get(sender) or record._others.get(sender, (-1, 0)))[0]


def fields_of(data):
    """Return a header as a dict, or None if it is not a JSON object."""
    try:
        fields = json.loads(data.decode())  # as text: given bytes, it would read past a byte order mark
    except ValueError:
        return None
    return fields if isinstance(fields, dict) else None


def wrap(owner, name, around):
    """Replace the method `name` of this one object by `around(inner, *arguments)`."""
    inner = getattr(owner, name)
    setattr(owner, name, lambda *arguments, **options: around(inner, *arguments, **options))


def bend_twists(robot, change):
    """`change(fields, message)` may change the header's fields in place, or return other (header, payload) bytes."""
    wrap(robot, "on_twist", lambda inner, message: inner(_bent(message, change)))


def bend_requests(robot, change):
    """The same for requests; the third argument is the payload's fields."""

    def around(inner, message):
        header, payload = fields_of(message.header), fields_of(message.payload)
        if header is None or payload is None:
            return inner(message)
        change(header, payload)
        return inner(Message(message.channel, message.source, as_json(header), as_json(payload)))

    wrap(robot, "on_request", around)


def bend_acks(robot, change):
    """The same for acks."""
    wrap(robot, "on_ack", lambda inner, message: inner(_bent(message, change)))


def bend_out(robot, name, change):
    """`change(header, payload)` changes fields of what is published on channel `name`; payload is None for bytes."""

    def around(inner, message):
        if message.channel.name != name:
            return inner(message)
        header, payload = fields_of(message.header), fields_of(message.payload) if name != "frame" else None
        change(header, payload)
        data = message.payload if payload is None else as_json(payload)
        return inner(Message(message.channel, "", as_json(header), data))

    wrap(robot, "emit", around)


def as_json(fields):
    """Compact JSON."""
    return json.dumps(fields, separators=(",", ":")).encode()


def _bent(message, change):
    fields = fields_of(message.header)
    result = change(fields, message) if fields is not None else None
    if isinstance(result, tuple):
        return Message(message.channel, message.source, *result)
    if fields is None:
        return message
    return Message(message.channel, message.source, as_json(fields), message.payload)
