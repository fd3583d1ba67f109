"""Small wrong changes of one syntax node: the mutants of the gate. Pure.

`replacements(node)` gives what could stand in a node's place: the next comparison, a constant one off, the other
branch, `min` for `max`, another member of an enum, a pattern with one byte less ...
"""

import ast
import copy
import re
from collections.abc import Callable, Iterator

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import State, Verb

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
}
_SWAPPED_CALLS = {"min": "max", "max": "min", "any": "all", "all": "any", "sin": "cos", "cos": "sin"}
_SWAPPED_KEYWORDS = {"gt": "ge", "ge": "gt", "lt": "le", "le": "lt"}
_EVENTS = ("ARM", "DISARM", "STOP", "RESET", "FAULT", "FREE", "SLOWED", "MUST_HOLD", "EXPIRED", "HUMAN_LOST")
_ENUMS = {
    "State": tuple(State.__members__),
    "Verb": tuple(Verb.__members__),
    "RejectReason": tuple(RejectReason.__members__),
    "Event": _EVENTS,  # spelt out: its file is judged too, and may not be imported before its mutants
}
_WORD = re.compile(r"[a-z0-9]{0,16}")


def replacements(node: ast.AST) -> Iterator[ast.AST]:
    """Every wrong node that may stand in the place of `node`."""
    operator = _OPERATORS.get(type(node))
    if operator is not None:
        yield from operator(node)


def without(statement: ast.stmt) -> ast.stmt | None:
    """What is left when `statement` is removed; None if it is of a kind that is not."""
    removable = (ast.Assign, ast.AnnAssign, ast.AugAssign, ast.Raise, ast.Return, ast.Expr)
    return ast.Pass() if isinstance(statement, removable) else None


def _compare(node: ast.Compare) -> Iterator[ast.AST]:
    for index, op in enumerate(node.ops):
        for other in _COMPARISONS[type(op)]:
            changed = copy.copy(node)
            changed.ops = [*node.ops[:index], other(), *node.ops[index + 1 :]]
            yield changed


def _boolean(node: ast.BoolOp) -> Iterator[ast.AST]:
    yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    for index in range(len(node.values)):
        rest = [*node.values[:index], *node.values[index + 1 :]]
        yield rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)


def _unary(node: ast.UnaryOp) -> Iterator[ast.AST]:
    if isinstance(node.op, ast.Not | ast.USub):
        yield node.operand


def _binary(node: ast.BinOp) -> Iterator[ast.AST]:
    if type(node.op) in _ARITHMETIC:
        yield ast.BinOp(node.left, _ARITHMETIC[type(node.op)](), node.right)


def _augmented(node: ast.AugAssign) -> Iterator[ast.AST]:
    if type(node.op) in _ARITHMETIC:
        yield ast.AugAssign(node.target, _ARITHMETIC[type(node.op)](), node.value)


def _constant(node: ast.Constant) -> Iterator[ast.AST]:
    yield from (ast.Constant(value) for value in _near(node.value))


def _near(value: object) -> Iterator[bool | int | float | bytes | str]:
    match value:
        case bool():
            yield not value
        case int():
            yield from (value - 1, value + 1)
        case float():
            yield from (value * 0.99 - (value == 0) / 100, value * 1.01 + (value == 0) / 100)
        case bytes():
            yield from _near_bytes(value)
        case str() if _WORD.fullmatch(value):
            yield value + "x"


def _near_bytes(value: bytes) -> Iterator[bytes]:
    """One byte less, or one digit off: enough to break any part of a grammar."""
    for at in range(len(value)):
        yield value[:at] + value[at + 1 :]
        if value[at : at + 1].isdigit():
            digits = (digit for digit in (value[at] - 49, value[at] - 47) if 0 <= digit <= 9)
            yield from (value[:at] + b"%d" % digit + value[at + 1 :] for digit in digits)


def _conditional(node: ast.IfExp) -> Iterator[ast.AST]:
    yield from (node.body, node.orelse)


def _condition(node: ast.If | ast.While) -> Iterator[ast.AST]:
    changed = copy.copy(node)
    changed.test = ast.UnaryOp(ast.Not(), node.test)
    yield changed


def _comprehension(node: ast.comprehension) -> Iterator[ast.AST]:
    for index in range(len(node.ifs)):
        changed = copy.copy(node)
        changed.ifs = [*node.ifs[:index], *node.ifs[index + 1 :]]
        yield changed


def _returned(node: ast.Return) -> Iterator[ast.AST]:
    if node.value is not None and not (isinstance(node.value, ast.Constant) and node.value.value is None):
        yield ast.Return(ast.Constant(None))


def _call(node: ast.Call) -> Iterator[ast.AST]:
    name = ast.unparse(node.func).removeprefix("math.")
    if name in _SWAPPED_CALLS:
        changed = copy.copy(node)
        prefix = "math." if isinstance(node.func, ast.Attribute) else ""
        changed.func = ast.parse(prefix + _SWAPPED_CALLS[name], mode="eval").body
        yield changed
    if name == "abs":
        yield node.args[0]
    for index, keyword in enumerate(node.keywords):
        if keyword.arg in _SWAPPED_KEYWORDS:
            changed, other = copy.copy(node), ast.keyword(_SWAPPED_KEYWORDS[keyword.arg], keyword.value)
            changed.keywords = [*node.keywords[:index], other, *node.keywords[index + 1 :]]
            yield changed


def _member(node: ast.Attribute) -> Iterator[ast.AST]:
    if isinstance(node.value, ast.Name) and node.attr in _ENUMS.get(node.value.id, ()):
        members = _ENUMS[node.value.id]
        yield ast.Attribute(node.value, members[(members.index(node.attr) + 1) % len(members)], node.ctx)


_OPERATORS: dict[type[ast.AST], Callable[..., Iterator[ast.AST]]] = {
    ast.Compare: _compare,
    ast.BoolOp: _boolean,
    ast.UnaryOp: _unary,
    ast.BinOp: _binary,
    ast.AugAssign: _augmented,
    ast.Constant: _constant,
    ast.IfExp: _conditional,
    ast.If: _condition,
    ast.While: _condition,
    ast.comprehension: _comprehension,
    ast.Return: _returned,
    ast.Call: _call,
    ast.Attribute: _member,
}
