"""Finds every mutant of a file and names it so that the name outlives edits elsewhere. Pure."""

import ast
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from types import CodeType

from tests.mutation.operators import replacements, without


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: in `file`, inside `where` (qualified name), `before` became `after`; `nth` tells equal ones apart."""

    file: str
    where: str
    line: int
    before: str
    after: str
    nth: int
    code: CodeType

    @property
    def name(self) -> tuple[str, str, str, str, int]:
        """What identifies it; the line is for people only."""
        return self.file, self.where, self.before, self.after, self.nth


@dataclass(frozen=True, slots=True)
class _Slot:
    """A place in the tree that holds one node."""

    owner: ast.AST
    field: str
    index: int | None
    where: str

    @property
    def node(self) -> ast.AST:
        held = getattr(self.owner, self.field)
        node: ast.AST = held if self.index is None else held[self.index]
        return node

    def put(self, node: ast.AST) -> None:
        if self.index is None:
            setattr(self.owner, self.field, node)
        else:
            getattr(self.owner, self.field)[self.index] = node


def mutants(file: str, source: str) -> Iterator[Mutant]:
    """Every mutant of `source`, compiled. Those that compile to the same code as another are given once."""
    tree = ast.parse(source)
    seen, count = {_text(tree)}, Counter[tuple[str, str, str]]()
    for slot in list(_slots(tree, "")):
        original = slot.node
        for changed in _changes(slot):
            slot.put(ast.copy_location(changed, original))
            text = _text(tree)
            if text not in seen:
                seen.add(text)
                key = slot.where, _text(original), _text(changed)
                count[key] += 1
                code = compile(ast.fix_missing_locations(tree), file, "exec")
                line = getattr(original, "lineno", 0)
                yield Mutant(file, slot.where, line, *key[1:], count[key], code)
            slot.put(original)


def _text(node: ast.AST) -> str:
    return ast.unparse(node)


def _changes(slot: _Slot) -> Iterator[ast.AST]:
    node = slot.node
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and isinstance(slot.owner, ast.Assign):
        return  # the label of an enum member; nothing decides by it
    yield from replacements(node)
    if isinstance(node, ast.stmt) and slot.where and not isinstance(slot.owner, ast.ClassDef):
        removed = without(node)
        if removed is not None:
            yield removed


def _slots(node: ast.AST, where: str) -> Iterator[_Slot]:
    """Every place below `node`; decorators and docstrings are left alone."""
    inside = f"{where}.{node.name}".lstrip(".") if isinstance(node, ast.FunctionDef | ast.ClassDef) else where
    for field, value in ast.iter_fields(node):
        if field == "decorator_list":
            continue
        for index, child in enumerate(value if isinstance(value, list) else [value]):
            if isinstance(child, ast.AST) and not _is_docstring(child):
                yield _Slot(node, field, index if isinstance(value, list) else None, inside)
                yield from _slots(child, inside)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
