"""Make every mutant of a file, and give it a name that outlives edits in other places. Pure."""

import ast
import copy
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import CodeType
from typing import Any

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import State, Verb

Name = tuple[str, str, str, str, int]


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: in `file`, inside `where` (qualified name), `before` became `after`; `nth` counts equal changes."""

    file: str
    where: str
    line: int
    before: str
    after: str
    nth: int
    code: CodeType

    @property
    def name(self) -> Name:
        """Return the identity; the line is not a part of it."""
        return self.file, self.where, self.before, self.after, self.nth


def equivalents(text: str) -> dict[Name, str]:
    """Read the reasons of the mutants that no test can kill from the text of `equivalents.toml`."""
    rows = tomllib.loads(text).get("equivalent", [])
    return {(row["file"], row["where"], row["before"], row["after"], row.get("nth", 1)): row["reason"] for row in rows}


def mutants(file: str, source: str) -> Iterator[Mutant]:
    """Give every mutant of `source`, compiled. Of mutants of a statement with the same text it gives the first."""
    tree = ast.parse(source)
    seen, count = set[tuple[int, str]](), Counter[tuple[str, str, str]]()
    for owner, field, index, where, statement in list(_places(tree, "", tree)):
        # A field that holds one node is handled as a list of one.
        nodes = getattr(owner, field) if index is not None else [getattr(owner, field)]
        original = nodes[index or 0]
        seen.add((id(statement), ast.unparse(statement)))
        for change in _changes(owner, original, where):
            # A copy: a change may be a part of the original, which keeps its own location.
            nodes[index or 0] = changed = ast.copy_location(copy.copy(change), original)
            setattr(owner, field, nodes if index is not None else nodes[0])
            text = id(statement), ast.unparse(changed if original is statement else statement)
            if text not in seen:
                seen.add(text)
                key = where, ast.unparse(original), ast.unparse(changed)
                count[key] += 1
                code = compile(ast.fix_missing_locations(tree), file, "exec")
                yield Mutant(file, where, getattr(original, "lineno", 0), *key[1:], count[key], code)
        nodes[index or 0] = original
        setattr(owner, field, nodes if index is not None else original)


def _places(node: ast.AST, where: str, statement: ast.AST) -> Iterator[tuple[ast.AST, str, int | None, str, ast.AST]]:
    """Give (owner, field, index, qualified name, statement) of every node below `node`, without decorators, docstrings.

    The statement is the innermost one that the node is or is in.
    """
    inside = f"{where}.{node.name}".lstrip(".") if isinstance(node, ast.FunctionDef | ast.ClassDef) else where
    for field, value in ast.iter_fields(node):
        if field != "decorator_list":
            for index, child in enumerate(value if isinstance(value, list) else [value]):
                docstring = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
                if isinstance(child, ast.AST) and not docstring:
                    within = child if isinstance(child, ast.stmt) else statement
                    yield node, field, index if isinstance(value, list) else None, inside, within
                    yield from _places(child, inside, within)


def _changes(owner: ast.AST, node: ast.AST, where: str) -> Iterator[ast.AST]:
    if isinstance(owner, ast.Assign) and isinstance(node, ast.Constant) and isinstance(node.value, str):
        return  # the label of an enum member: no decision depends on it
    yield from _OPERATORS.get(type(node), lambda _: iter(()))(node)
    removable = ast.Assign | ast.AnnAssign | ast.AugAssign | ast.Raise | ast.Return | ast.Expr
    if isinstance(node, removable) and where and not isinstance(owner, ast.ClassDef):
        yield ast.Pass()


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
# The members of Event stand here as text: its file has mutants too and must not be imported before them.
_EVENTS = ("ARM", "DISARM", "STOP", "RESET", "FAULT", "FREE", "SLOWED", "MUST_HOLD", "EXPIRED", "HUMAN_LOST")
_ENUMS = {
    "State": tuple(State.__members__),
    "Verb": tuple(Verb.__members__),
    "RejectReason": tuple(RejectReason.__members__),
    "Event": _EVENTS,
}
_WORD = re.compile(r"[a-z0-9]{0,16}")


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for field, value in fields.items():
        setattr(changed, field, value)
    return changed


def _at(items: list[Any], index: int, *new: object) -> list[Any]:
    return [*items[:index], *new, *items[index + 1 :]]


def _compare(node: ast.Compare) -> Iterator[ast.AST]:
    for index, op in enumerate(node.ops):
        yield from (_with(node, ops=_at(node.ops, index, other())) for other in _COMPARISONS[type(op)])


def _boolean(node: ast.BoolOp) -> Iterator[ast.AST]:
    yield _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    for index in range(len(node.values)):
        rest = _at(node.values, index)
        yield rest[0] if len(rest) == 1 else _with(node, values=rest)


def _unary(node: ast.UnaryOp) -> Iterator[ast.AST]:
    if isinstance(node.op, ast.Not | ast.USub):
        yield node.operand


def _arithmetic(node: ast.BinOp | ast.AugAssign) -> Iterator[ast.AST]:
    if type(node.op) in _ARITHMETIC:
        yield _with(node, op=_ARITHMETIC[type(node.op)]())


def _augmented(node: ast.AugAssign) -> Iterator[ast.AST]:
    yield from _arithmetic(node)
    yield ast.Assign([node.target], node.value)


def _constant(node: ast.Constant) -> Iterator[ast.AST]:
    match node.value:
        case bool() as value:
            near: Iterator[Any] = iter([not value])
        case int() as value:
            near = iter([value - 1, value + 1])
        case float() as value:
            near = iter([value * 0.99 - (value == 0) / 100, value * 1.01 + (value == 0) / 100])
        case bytes() as value:
            near = _near_bytes(value)
        case str() as value if _WORD.fullmatch(value):
            near = iter([value + "x"])
        case _:
            return
    yield from (ast.Constant(value) for value in near)


def _near_bytes(value: bytes) -> Iterator[bytes]:
    """Remove one byte, or move one digit by one: enough to break any part of a grammar."""
    for at in range(len(value)):
        yield value[:at] + value[at + 1 :]
        if value[at : at + 1].isdigit():
            digits = (digit for digit in (value[at] - 49, value[at] - 47) if 0 <= digit <= 9)
            yield from (value[:at] + b"%d" % digit + value[at + 1 :] for digit in digits)


def _conditional(node: ast.IfExp) -> Iterator[ast.AST]:
    yield from (node.body, node.orelse)


def _condition(node: ast.If | ast.While) -> Iterator[ast.AST]:
    if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return  # what only the type checker imports decides nothing
    yield _with(node, test=ast.UnaryOp(ast.Not(), node.test))


def _comprehension(node: ast.comprehension) -> Iterator[ast.AST]:
    yield from (_with(node, ifs=_at(node.ifs, index)) for index in range(len(node.ifs)))


def _returned(node: ast.Return) -> Iterator[ast.AST]:
    if node.value is not None and not (isinstance(node.value, ast.Constant) and node.value.value is None):
        yield ast.Return(ast.Constant(None))


def _call(node: ast.Call) -> Iterator[ast.AST]:
    prefix, name = "math." * isinstance(node.func, ast.Attribute), ast.unparse(node.func).removeprefix("math.")
    if name in _SWAPPED_CALLS:
        yield _with(node, func=ast.parse(prefix + _SWAPPED_CALLS[name], mode="eval").body)
    if name == "abs":
        yield node.args[0]
    for index, keyword in enumerate(node.keywords):
        if keyword.arg in _SWAPPED_KEYWORDS:
            other = ast.keyword(_SWAPPED_KEYWORDS[keyword.arg], keyword.value)
            yield _with(node, keywords=_at(node.keywords, index, other))


def _member(node: ast.Attribute) -> Iterator[ast.AST]:
    members = _ENUMS.get(node.value.id, ()) if isinstance(node.value, ast.Name) else ()
    if node.attr in members:
        yield _with(node, attr=members[(members.index(node.attr) + 1) % len(members)])


_OPERATORS: dict[type[ast.AST], Callable[..., Iterator[ast.AST]]] = {
    ast.Compare: _compare,
    ast.BoolOp: _boolean,
    ast.UnaryOp: _unary,
    ast.BinOp: _arithmetic,
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
