"""Why a V4L2 device cannot be used, in one line with the fix. Shell (looks at /dev and /proc; Linux)."""

import errno
import grp
import os
import stat
from pathlib import Path

from sightline.protocol.errors import HardwareError


def check_device(path: Path) -> None:
    """Raise HardwareError if `path` is absent, no device, or not permitted; opening it would only say "failed"."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        raise _trouble(path, error) from None
    try:
        if not stat.S_ISCHR(os.fstat(descriptor).st_mode):
            raise HardwareError(f"{path} is no camera device{_others(path)}; set camera.options.device")
    finally:
        os.close(descriptor)


def open_error(path: Path) -> HardwareError:
    """The error for a device that is there and permitted, but did not open as a camera."""
    owner = device_owner(path)
    if owner:
        return HardwareError(f"camera {path} is busy: {owner} has it open; end that program")
    return HardwareError(
        f"camera {path} does not open: it is busy, or no source of pictures as many cameras' second node is none"
        f"{_others(path)}; set camera.options.device"
    )


def device_owner(path: Path) -> str:
    """`cheese (pid 4711)` for another process that has `path` open; "" where that cannot be found out."""
    device = str(path.resolve())
    for process in Path("/proc").glob("[0-9]*"):
        if process.name != str(os.getpid()) and device in _open_files(process):
            return f"{_name(process)} (pid {process.name})"
    return ""


def _trouble(path: Path, error: OSError) -> HardwareError:
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR):
        return HardwareError(f"camera {path} is not there{_others(path)}; plug it in, or set camera.options.device")
    if error.errno in (errno.EACCES, errno.EPERM):
        return HardwareError(
            f"camera {path} may not be opened by this user, only by its group {_group(path)!r}: "
            f"sudo usermod -aG {_group(path)} $USER, then log in anew"
        )
    if error.errno == errno.EBUSY:
        return open_error(path)
    return HardwareError(f"camera {path} cannot be opened: {error.strerror}; set camera.options.device")


def _others(path: Path) -> str:
    """What could have been meant."""
    there = [str(other) for other in sorted(Path("/dev").glob("video*")) if other != path]
    return f" (there are: {', '.join(there)})" if there else " (no /dev/video* is there)"


def _group(path: Path) -> str:
    """`video`, unless the device says otherwise."""
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
    except (OSError, KeyError):
        return "video"
    return group if group != "root" else "video"


def _open_files(process: Path) -> set[str]:
    try:
        return {_target(link) for link in (process / "fd").iterdir()}
    except OSError:  # gone, or not ours to look at
        return set()


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except OSError:  # closed meanwhile
        return ""


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text("utf-8", "replace").strip()
    except OSError:
        return "a process"
