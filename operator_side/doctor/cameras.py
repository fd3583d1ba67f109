"""What the doctor finds about cameras: the formats they offer, the rate they deliver. Shell (devices; Linux)."""

from __future__ import annotations

import errno
import fcntl
import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from sightline.operator_side.doctor.finding import Finding, trouble
from sightline.protocol.errors import SightlineError

DEVICES: Final = Path("/dev")
_MEASURED_S: Final = 3.0
_ENOUGH: Final = 0.9
_ENUM_FMT: Final = 0xC0405602
"""The kernel's VIDIOC_ENUM_FMT: read and write, 64 bytes, 'V', 2 (linux/videodev2.h)."""
_FORMAT: Final = struct.Struct("III32sII12x")
"""v4l2_fmtdesc: index, type, flags, description, pixel format, bus code."""
_CAPTURE: Final = 1
_MOST_FORMATS: Final = 64
_UNOPENED: Final = {
    errno.EACCES: "sudo usermod -aG video $USER, then log in anew",
    errno.EBUSY: "end the other program that has it: sudo fuser -v",
}


def modes() -> Iterator[Finding]:
    """The formats of every camera device of this machine; those that give none are no cameras."""
    for device in sorted(DEVICES.glob("video[0-9]*")):
        try:
            offered = formats(device)
        except OSError as error:
            fix = _UNOPENED.get(error.errno or 0, "plug it in anew")
            yield Finding(f"modes {device.name}", False, f"cannot be opened: {error.strerror}",
                          f"{fix} {device}" if "fuser" in fix else fix)
            continue
        if offered:
            yield _finding(device, offered)


def _finding(device: Path, offered: list[str]) -> Finding:
    said, option = ", ".join(offered), f"--set camera.kind=v4l2 --set camera.options.device={device}"
    if "MJPG" in offered or "JPEG" in offered:
        return Finding(f"modes {device.name}", True, f"{said}; its own JPEG is passed through (MJPG, the default)")
    if "YUYV" in offered:
        return Finding(f"modes {device.name}", None, f"{said}; no JPEG of its own: each picture is encoded here",
                       f"sightline robot {option} --set camera.options.format=YUYV")
    return Finding(f"modes {device.name}", False, f"{said}; neither MJPG nor YUYV", "use another camera")


def formats(device: Path) -> list[str]:
    """The four-letter codes of what `device` captures, its default first. Raises OSError where it cannot be asked."""
    handle = os.open(device, os.O_RDWR | os.O_NONBLOCK)
    try:
        return [code for index in range(_MOST_FORMATS) if (code := _format(handle, index))]
    finally:
        os.close(handle)


def _format(handle: int, index: int) -> str:
    asked = _FORMAT.pack(index, _CAPTURE, 0, b"", 0, 0)
    try:
        answer = fcntl.ioctl(handle, _ENUM_FMT, asked)
    except OSError:  # no more of them, or no camera at all
        return ""
    return read_format(answer)


def read_format(answer: bytes) -> str:
    """The code in the kernel's answer."""
    code: int = _FORMAT.unpack(answer)[4]
    return code.to_bytes(4, "little").decode("ascii", "replace").strip()


def delivered(kind: str, sets: list[str]) -> Finding:
    """The rate that a camera really delivers; what it cannot do at all, it says itself."""
    from sightline.operator_side.calibrate.local_camera import local_camera

    try:
        with local_camera(kind, sets) as opened:
            begun_s, stamps_us = time.monotonic(), []
            while time.monotonic() - begun_s < _MEASURED_S:
                picture = opened.read(0.5)
                stamps_us += [picture.t_us] if picture else []
    except SightlineError as error:
        return trouble(f"camera {kind}", error)
    if len(stamps_us) < 2:
        return Finding(f"camera {kind}", False, "no pictures", "plug it in anew; another program may have it")
    fps = (len(stamps_us) - 1) / (stamps_us[-1] - stamps_us[0]) * 1e6
    asked = next((float(one.partition("=")[2]) for one in sets if one.startswith("fps=")), 0.0)
    fix = "more light (a camera exposes longer in the dark), a smaller size, or another USB port"
    return Finding(f"camera {kind}", fps >= _ENOUGH * asked, f"{fps:.1f}", fix, "fps", f"{asked:g}")
