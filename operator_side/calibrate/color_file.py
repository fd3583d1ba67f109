"""Writes color ranges into a vision configuration and leaves everything else as it was. Shell (files).

The text is cut into statements by a small scanner; what comes out is read again by Python's TOML reader and must say
what was meant, or nothing is changed.
"""

import re
import shutil
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2

from sightline.operator_side.calibrate.color import Image, Ranges, mask_picture
from sightline.operator_side.config.loading import load_service
from sightline.protocol.errors import ConfigError

_TABLE: Final = ("hsv",)
_KEY: Final = ("hsv", "ranges")
_STRING: Final = re.compile(r'"""(?:\\.|[^\\])*?"""|\'\'\'.*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'', re.DOTALL)
KeyPath = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Statement:
    """Text from `start` to `end`: a table's head, or a key with its value. `path` is in full."""

    start: int
    end: int
    path: KeyPath
    is_head: bool


def ranges_toml(ranges: Ranges) -> str:
    """The value as TOML, one range a line; what is a default of the range is left out."""
    rows = [", ".join(f"{name} = {getattr(one, name):g}" for name in
                      ("hue_low_deg", "hue_high_deg", "saturation_low", "value_low")) for one in ranges]
    return "[\n" + "".join(f"  {{ {row} }},\n" for row in rows) + "]"


def with_ranges(text: str, ranges: Ranges) -> str:
    """`text` with `hsv.ranges` set. Raises ConfigError for what is no TOML, or where it cannot be put in safely."""
    try:
        before = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is no TOML: {error}") from None
    after = _edited(text, ranges)
    try:
        right = tomllib.loads(after) == _meant(before, ranges)
    except tomllib.TOMLDecodeError:
        right = False
    if not right:
        lines = " ".join(f"ranges = {ranges_toml(ranges)}".split())
        raise ConfigError(f"its [hsv] is written in a way that cannot be changed safely; put in by hand: {lines}")
    return after


def _meant(before: dict[str, Any], ranges: Ranges) -> dict[str, Any]:
    hsv = before.get("hsv", {})
    return {**before, "hsv": {**(hsv if isinstance(hsv, dict) else {}),
                              "ranges": tomllib.loads(f"ranges = {ranges_toml(ranges)}")["ranges"]}}


def _edited(text: str, ranges: Ranges) -> str:
    statements = list(_statements(text))
    value = f"ranges = {ranges_toml(ranges)}\n"
    old = [one for one in statements if one.path == _KEY and not one.is_head]
    if old:
        key = text[old[0].start : old[0].end].partition("=")[0].rstrip()
        kept = _comments(text[old[0].start : old[0].end])
        return text[: old[0].start] + kept + f"{key} = {ranges_toml(ranges)}" + text[old[0].end :]
    blocks = [number for number, one in enumerate(statements) if one.is_head and one.path == _KEY]
    if blocks:
        return _without_blocks(text, statements, blocks, f"[[hsv.ranges]]\n{_as_blocks(ranges)}")
    heads = [one for one in statements if one.is_head and one.path == _TABLE]
    if heads:
        end = text.find("\n", heads[0].end) + 1 or len(text)
        return text[:end] + ("" if text[:end].endswith("\n") else "\n") + value + text[end:]
    gap = "" if not text or text.endswith("\n\n") else "\n" if text.endswith("\n") else "\n\n"
    return f"{text}{gap}[hsv]\n{value}"


def _as_blocks(ranges: Ranges) -> str:
    names = ("hue_low_deg", "hue_high_deg", "saturation_low", "value_low")
    return "\n[[hsv.ranges]]\n".join("".join(f"{name} = {getattr(one, name):g}\n" for name in names) for one in ranges)


def _without_blocks(text: str, statements: Sequence[_Statement], blocks: Sequence[int], new: str) -> str:
    """Every `[[hsv.ranges]]` taken out, but for its lines of comment; `new` where the first was."""
    parts, at = [], 0
    for number in blocks:
        last = number
        while last + 1 < len(statements) and not statements[last + 1].is_head:
            last += 1
        end = text.find("\n", statements[last].end) + 1 or len(text)
        parts.append(text[at : statements[number].start] + _comments(text[statements[number].start : end]))
        parts += [new] if number == blocks[0] else []
        at = end
    return "".join(parts) + text[at:]


def _comments(text: str) -> str:
    """Every comment in `text`, a line each."""
    found, at = [], 0
    while at < len(text):
        string = _STRING.match(text, at)
        if text[at] == "#":
            found.append(text[at : _line_end(text, at)].rstrip())
            at = _line_end(text, at)
        else:
            at = string.end() if string else at + 1
    return "".join(f"{line}\n" for line in found)


# --- the scanner ---------------------------------------------------------------------------------------------------


def _statements(text: str) -> Iterator[_Statement]:
    """Of text that is TOML."""
    at, table = 0, KeyPath()
    while at < len(text):
        if text[at] in " \t\r\n":
            at += 1
        elif text[at] == "#":
            at = _line_end(text, at)
        else:
            end, is_head = at + len(text[at : _end_of(text, at)].rstrip()), text[at] == "["
            path = _path_of(text[at:end] if is_head else text[at:end].partition("=")[0] + "= 0")
            table = path if is_head else table
            yield _Statement(at, end, path if is_head else table + path, is_head)
            at = end


def _end_of(text: str, at: int) -> int:
    """Where a statement ends: at the end of its line, unless a string or a bracket goes on."""
    depth = 0
    while at < len(text):
        string = _STRING.match(text, at)
        if string:
            at = string.end()
            continue
        depth += (text[at] in "[{") - (text[at] in "]}")
        if depth <= 0 and text[at] in "#\n":
            break
        at = _line_end(text, at) if text[at] == "#" else at + 1
    return at


def _line_end(text: str, at: int) -> int:
    found = text.find("\n", at)
    return len(text) if found < 0 else found


def _path_of(statement: str) -> KeyPath:
    """The names of a head or a key, as TOML reads them; nothing for a key that the scanner took apart wrongly."""
    try:
        node: Any = tomllib.loads(statement)
    except tomllib.TOMLDecodeError:
        return ()
    path: list[str] = []
    while isinstance(node, dict) and node:
        name, node = next(iter(node.items()))
        path.append(name)
        node = node[0] if isinstance(node, list) and node else node
    return tuple(path)


# Writes colour ranges into a vision configuration, and mask pictures. Shell (files).


def check_config(path: Path) -> None:
    """Raise ConfigError for a configuration that vision would refuse, or one that cannot be there."""
    if path.exists():
        load_service("vision", file=str(path), environ={})
    elif not path.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {path.parent}")


def write_ranges(path: Path, ranges: Ranges) -> None:
    """Set `hsv.ranges` in the file, or begin a new one; it is changed whole or not at all. Raises ConfigError."""
    unfinished = path.with_name(f".{path.name}.part")
    try:
        before = path.read_text("utf-8") if path.exists() else ""
        after = with_ranges(before, ranges)
        unfinished.write_text(after, "utf-8")
        if path.exists():
            shutil.copymode(path, unfinished)
        load_service("vision", file=str(unfinished), environ={})  # what vision would refuse is not written
        unfinished.replace(path)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or 'is no text'}") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    finally:
        unfinished.unlink(missing_ok=True)


def write_mask(path: Path, ranges: Ranges, picture: Image) -> None:
    """The mask picture as PNG. Raises ConfigError where it cannot be written."""
    try:
        path.write_bytes(mask_png(ranges, picture))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None


def mask_png(ranges: Ranges, picture: Image) -> bytes:
    """What the ranges mark, beside the mask, as PNG."""
    return bytes(cv2.imencode(".png", mask_picture(ranges, picture))[1])
