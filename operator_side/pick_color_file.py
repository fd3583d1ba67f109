"""Writes colour ranges into a vision configuration, and mask pictures. Shell (files)."""

import shutil
from pathlib import Path

import cv2

from sightline.operator_side.calibrate.color import Image, Ranges, mask_picture
from sightline.operator_side.calibrate.color_file import with_ranges
from sightline.operator_side.service_settings import load_service
from sightline.protocol.errors import ConfigError


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
