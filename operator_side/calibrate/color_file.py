"""Writes color ranges into a configuration of the vision service and keeps the rest. Shell (files).

tomlkit edits the text, because the standard library only reads TOML. Python's TOML reader then checks the result. If it
is not as intended, the file stays unchanged.
"""

import os
import re
import shutil
import tomllib
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any, Final

import cv2
import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Item

from sightline.operator_side.calibrate.color import Image, Ranges, mask_picture
from sightline.operator_side.config.loading import load_service
from sightline.protocol.errors import ConfigError

_FIELDS: Final = ("hue_low_deg", "hue_high_deg", "saturation_low", "value_low")


def ranges_toml(ranges: Ranges) -> str:
    """Format ranges as TOML, one range per line, without defaults."""
    rows = [", ".join(f"{name} = {getattr(one, name):g}" for name in _FIELDS) for one in ranges]
    return "[\n" + "".join(f"  {{ {row} }},\n" for row in rows) + "]"


def with_ranges(text: str, ranges: Ranges) -> str:
    """Return `text` with `hsv.ranges` set. Raises ConfigError for invalid TOML, or if it cannot be set safely."""
    try:
        before = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"invalid TOML: {error}") from None
    try:
        after = _edited(text, ranges)
        right = tomllib.loads(after) == _meant(before, ranges)
    except (TOMLKitError, tomllib.TOMLDecodeError):
        right = False
    if not right:
        lines = " ".join(f"ranges = {ranges_toml(ranges)}".split())
        raise ConfigError(f"cannot change its [hsv] safely; insert by hand: {lines}")
    return after


def _meant(before: dict[str, Any], ranges: Ranges) -> dict[str, Any]:
    hsv = before.get("hsv", {})
    return {**before, "hsv": {**(hsv if isinstance(hsv, dict) else {}),
                              "ranges": tomllib.loads(f"ranges = {ranges_toml(ranges)}")["ranges"]}}


def _edited(text: str, ranges: Ranges) -> str:
    document = tomlkit.parse(text)
    hsv = document.setdefault("hsv", tomlkit.table())
    if isinstance(hsv, MutableMapping) and not isinstance(hsv, InlineTable):
        hsv["ranges"] = _item(ranges, hsv.get("ranges"))
    after = document.as_string()
    return after if after.endswith("\n") else f"{after}\n"  # tomlkit ends a new array without a line end


def _item(ranges: Ranges, old: Item | None) -> Any:
    """Return the ranges as an array, or as tables if `old` has tables. Comments of `old` come first."""
    comments = "".join(f"{line.rstrip()}\n" for line in re.findall("#.*", old.as_string() if old else ""))
    if isinstance(old, AoT):
        blocks = ["".join(f"{name} = {getattr(one, name):g}\n" for name in _FIELDS) for one in ranges]
        space = "\n" if re.search(r"\n\r?\n$", old.as_string()) else ""  # the blank line before the next table
        return tomlkit.parse(f"[[ranges]]\n{comments}" + "\n[[ranges]]\n".join(blocks) + space)["ranges"]
    array = ranges_toml(ranges).replace("[\n", f"[\n{comments}", 1)
    return tomlkit.parse(f"ranges = {array}")["ranges"]


# --- files: the configuration and the mask -----------------------------------------------------------------------


def check_config(path: Path) -> None:
    """Raise ConfigError for an invalid or unwritable configuration of the vision service."""
    if path.exists() and not path.is_file():  # a pipe would block, and a device would become a file
        raise ConfigError(f"cannot write {path}: it is not a regular file; choose another file")
    if path.exists():
        load_service("vision", file=str(path), environ={})
    elif not path.parent.is_dir():
        raise ConfigError(f"cannot write {path}: no folder {path.parent}; create it first")


def write_ranges(path: Path, ranges: Ranges) -> None:
    """Set `hsv.ranges` in the file, or create the file. The change is atomic. Raises ConfigError.

    A symbolic link and the line ends are preserved.
    """
    target = Path(os.path.realpath(path))
    unfinished = target.with_name(f".{target.name}.part")
    try:
        before = target.read_bytes().decode() if target.exists() else ""
        mark = "\ufeff" if before.startswith("\ufeff") else ""  # byte order mark, which is not valid TOML
        after = mark + with_ranges(before.removeprefix(mark), ranges)
        if "\r\n" in before and "\n" not in before.replace("\r\n", ""):
            after = after.replace("\r\n", "\n").replace("\n", "\r\n")
        unfinished.write_bytes(after.encode())
        if target.exists():
            shutil.copymode(target, unfinished)
        load_service("vision", file=str(unfinished), environ={})  # raises for an invalid configuration
        unfinished.replace(target)
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not a text file"
        raise ConfigError(f"cannot write {path}: {why}; choose another file") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    finally:
        unfinished.unlink(missing_ok=True)


def write_mask(path: Path, ranges: Ranges, picture: Image) -> None:
    """Write the mask as PNG. Raises ConfigError if it cannot be written."""
    try:
        path.write_bytes(mask_png(ranges, picture))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}; choose another file") from None


def mask_png(ranges: Ranges, picture: Image) -> bytes:
    """Return the marked image next to the mask, as PNG."""
    return bytes(cv2.imencode(".png", mask_picture(ranges, picture))[1])
