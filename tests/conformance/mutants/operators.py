"""Operators: one small change of a peer's messages, or of one text in its source. Pure but for the files they read.

An operator of fields changes a message of one channel: `swap(fields, memory, a, b)`. `memory` is a dict of this mutant
and channel. A path names a field: `header.echo.seq`, `payload.applied.0`; `payload.0` of a twist is its first number.
An operator of messages gets a whole message and returns those that are passed on instead.
The operator `source` replaces a text in the function `place` (Python) or in the file `place` (JavaScript).
"""

import ast
import heapq
import importlib
import inspect
import itertools
import json
import textwrap
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace

from sightline.protocol.channels import CHANNELS, key_for, parse_key

MISSING = object()
OPAQUE = ("frame", "scan", "overlay", "preview", "ack")
"""Channels whose payload is not read here."""


class OperatorError(Exception):
    """An operator cannot do what its row requests; the text is one line."""


@dataclass(frozen=True)
class Parcel:
    """A message on its way."""

    key: str
    header: bytes
    payload: bytes

    @property
    def channel(self):
        """The name of the channel, or an empty text."""
        parsed = parse_key(self.key)
        return parsed[1].name if parsed else ""


class Fields:
    """The fields of a message, to be read and changed by path."""

    def __init__(self, parcel):
        self._parcel, self.changed = parcel, False
        self._parts = {"header": _object(parcel.header), "payload": _payload(parcel)}

    def get(self, path):
        """The value at `path`, or MISSING."""
        owner, name = self._owner(path)
        with suppress(LookupError, TypeError):
            return owner[name]
        return MISSING

    def set(self, path, value):
        """Replace the value at `path`, if the message has it or can have it."""
        owner, name = self._owner(path)
        if isinstance(owner, dict | list) and value is not MISSING:
            self.changed |= self.get(path) != value
            owner[name] = value

    def drop(self, path):
        """Remove the field at `path`."""
        owner, name = self._owner(path)
        if isinstance(owner, dict) and name in owner:
            self.changed = True
            del owner[name]

    def parcel(self):
        """The message with its changes; as it came without any."""
        if not self.changed:
            return self._parcel
        header, payload = self._parts["header"], self._parts["payload"]
        return replace(
            self._parcel,
            header=self._parcel.header if header is None else _packed(header),
            payload=self._parcel.payload if payload is None else _written(payload),
        )

    def _owner(self, path):
        *names, last = path.split(".")
        owner = self._parts
        for name in names:
            owner = owner.get(name) if isinstance(owner, dict) else None
        return owner, int(last) if isinstance(owner, list) else last


def _object(data):
    try:
        fields = json.loads(data.decode())
    except ValueError:
        return None
    return fields if isinstance(fields, dict) else None


def _payload(parcel):
    if parcel.channel != "twist":
        return None if parcel.channel in OPAQUE else _object(parcel.payload)
    try:
        numbers = [float(part) for part in parcel.payload.decode("ascii").split("|")]
    except ValueError:
        return None
    return numbers if len(numbers) == 2 else None


def _written(payload):
    return b"|".join(b"%.4f" % number for number in payload) if isinstance(payload, list) else _packed(payload)


def _packed(fields):
    return json.dumps(fields, separators=(",", ":")).encode()


# --- operators of fields ---------------------------------------------------------------------------------------------


def swap(fields, _memory, a, b):
    """Exchange two values."""
    one, other = fields.get(a), fields.get(b)
    fields.set(a, other)
    fields.set(b, one)


def negate(fields, _memory, field):
    """Flip the sign."""
    _compute(fields, field, lambda value: -value)


def add(fields, _memory, field, by):
    """Add a constant: off by one."""
    _compute(fields, field, lambda value: value + by)


def scale(fields, _memory, field, by):
    """Multiply by a constant: another unit."""
    _compute(fields, field, lambda value: value * by)


def copy(fields, _memory, field, of):
    """Write the value of another field."""
    fields.set(field, fields.get(of))


def put(fields, _memory, field, value):
    """Write a constant."""
    fields.set(field, value)


def drop(fields, _memory, field):
    """Leave the field out."""
    fields.drop(field)


def hold(fields, memory, field):
    """Write the first value for ever."""
    fields.set(field, memory.setdefault("first", fields.get(field)))


def late(fields, memory, field):
    """Write the value of the message before."""
    value, memory["last"] = memory.get("last", fields.get(field)), fields.get(field)
    fields.set(field, value)


def _compute(fields, path, change):
    value = fields.get(path)
    if isinstance(value, int | float) and not isinstance(value, bool):
        fields.set(path, round(change(value)) if isinstance(value, int) else change(value))


# --- operators of messages -------------------------------------------------------------------------------------------


def lose(parcel, memory, _later, every):
    """Lose one of `every` messages."""
    memory["count"] = memory.get("count", 0) + 1
    return [] if memory["count"] % every == 0 else [parcel]


def resend(parcel, memory, later, after_ms, every):
    """Send one of `every` messages again, as it was."""
    memory["count"] = memory.get("count", 0) + 1
    if memory["count"] % every == 0:
        later(after_ms * 1000, parcel)
    return [parcel]


def delay(parcel, _memory, later, by_ms):
    """Pass each message on later."""
    later(by_ms * 1000, parcel)
    return []


def rename(parcel, _memory, _later, source):
    """Send as another role."""
    robot, channel, _source = parse_key(parcel.key)
    return [replace(parcel, key=key_for(robot, channel, source))]


def append(parcel, _memory, _later, part, text):
    """Write more bytes at the end of header or payload."""
    return [replace(parcel, **{part: getattr(parcel, part) + text.encode()})]


def source(place, old, new):
    """Replace a text; `change_function` and `javascript.changed_copy` carry it out."""


OF_FIELDS = {"swap": swap, "negate": negate, "add": add, "scale": scale, "copy": copy, "put": put, "drop": drop,
             "hold": hold, "late": late}
OF_MESSAGES = {"lose": lose, "resend": resend, "delay": delay, "rename": rename, "append": append}
OF_SOURCE = {"source": source}
OPERATORS = OF_FIELDS | OF_MESSAGES | OF_SOURCE


def parameters_of(name):
    """Return the parameters that a row of this operator has, besides `message` and `when`."""
    return {one for one in inspect.signature(OPERATORS[name]).parameters
            if one not in ("fields", "parcel", "memory", "_memory", "later", "_later")}


class Tap:
    """Applies one operator to the messages of one channel that a peer sends or receives."""

    def __init__(self, peer, operator, message, when, parameters):
        """`peer` has `network`, `link` and `tick`; `when` maps paths to the values that a message must have."""
        self._peer, self._message, self._when = peer, message, when
        self._operator, self._parameters, self._memory = operator, parameters, {}
        self._waiting, self._numbers = [], itertools.count()
        self._put, self._receive, self._tick = peer.network.put, peer.link.receive, peer.tick
        peer.network.put, peer.link.receive, peer.tick = self._sent, self._received, self._ticked

    def _sent(self, key, header, payload, sender=None):
        if sender is not self._peer.link:
            return self._put(key, header, payload, sender)
        for one in self._changed(Parcel(key, header, payload), self._pass_out):
            self._pass_out(one)
        return True

    def _received(self, key, header, payload):
        for one in self._changed(Parcel(key, header, payload), self._pass_in):
            self._pass_in(one)

    def _pass_out(self, parcel):
        self._put(parcel.key, parcel.header, parcel.payload, self._peer.link)

    def _pass_in(self, parcel):
        self._receive(parcel.key, parcel.header, parcel.payload)

    def _ticked(self, now_us):
        self._tick(now_us)
        while self._waiting and self._waiting[0][0] <= now_us:
            _due_us, _number, pass_on, parcel = heapq.heappop(self._waiting)
            pass_on(parcel)

    def _changed(self, parcel, pass_on):
        if parcel.channel != self._message:
            return [parcel]
        fields = Fields(parcel)
        if any(fields.get(path) != value for path, value in self._when.items()):
            return [parcel]
        if self._operator in OF_FIELDS:
            OF_FIELDS[self._operator](fields, self._memory, **self._parameters)
            return [fields.parcel()]

        def later(delay_us, one):
            due_us = self._peer.network.now_us + delay_us
            heapq.heappush(self._waiting, (due_us, next(self._numbers), pass_on, one))

        return OF_MESSAGES[self._operator](parcel, self._memory, later, **self._parameters)


# --- the source of a Python peer -------------------------------------------------------------------------------------


@contextmanager
def change_function(place, old, new):
    """Run the block with one text of one function replaced, for every object of its class.

    Args:
        place: `module:function` or `module:Class.method`, e.g. `sightline.robot_side.safety.lease:Lease.take`.
        old: a text that the function's source has once.
        new: its replacement.

    Raises:
        OperatorError: there is no such function, or the text is not there once.
    """
    function, namespace = _function_at(place)
    text = textwrap.dedent(inspect.getsource(function))
    if text.count(old) != 1:
        raise OperatorError(f"{place} has {old!r} {text.count(old)} times; expected once")
    code = _code(text.replace(old, new), function, namespace, place)
    original, function.__code__ = function.__code__, code
    try:
        yield
    finally:
        function.__code__ = original


def _function_at(place):
    name, _, path = place.partition(":")
    try:
        module = found = importlib.import_module(name)
        for part in path.split("."):
            found = inspect.getattr_static(found, part)
    except (ImportError, AttributeError) as error:
        raise OperatorError(f"no function {place}: {error}") from None
    found = found.fget if isinstance(found, property) else getattr(found, "__func__", found)
    if not inspect.isfunction(found):
        raise OperatorError(f"{place} is not a function of Python")
    return found, vars(module)


def _code(text, function, namespace, place):
    try:
        (tree,) = ast.parse(text).body
        tree.decorator_list = []
        scope = dict(namespace)
        exec(compile(ast.Module([tree], []), function.__code__.co_filename, "exec"), scope)
    except (SyntaxError, ValueError) as error:
        raise OperatorError(f"{place}: the changed function cannot be compiled: {error}") from None
    code = scope[function.__name__].__code__
    if code.co_freevars != function.__code__.co_freevars:
        raise OperatorError(f"{place} uses a name of an enclosing scope, e.g. super(); choose another function")
    return code


CHANNEL_NAMES = frozenset(CHANNELS)
