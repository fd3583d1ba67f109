"""Finds problems of this machine: Python, packages, clock, ports, keys, cameras. Shell (reads the system; Linux)."""

from __future__ import annotations

import datetime
import errno
import fcntl
import os
import platform
import resource
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Final

from sightline.operator_side.doctor.finding import Finding, trouble
from sightline.operator_side.preflight import needs
from sightline.protocol import VERSION
from sightline.protocol.errors import SightlineError, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import MOST_SIDE_PX
from sightline.protocol.transports.diagnosis import listening_inodes, port_owner
from sightline.protocol.transports.security import EXPIRES_SOON
from sightline.protocol.transports.zenoh.session import MULTICAST_GROUP

PORTS = {7447: "Zenoh", 9090: "sightline.v1", 9091: "the legacy protocol"}
_HOT_C = 80.0
_STOLEN_PERCENT = 2.0
CPUS = Path("/sys/devices/system/cpu")
CGROUP = Path("/sys/fs/cgroup")
PROC_STAT = Path("/proc/stat")
INTERFACES = Path("/sys/class/net")
_EXTRAS = {"zenoh": "eclipse-zenoh", "websocket": "websockets", "vision": "opencv-python-headless", "sim": "pybullet"}


def findings(keys_folder: str) -> Iterator[Finding]:
    """Yield the findings about this machine."""
    yield _versions()
    yield _collision()
    yield from (_port(port, what) for port, what in PORTS.items())
    yield _real_time()
    yield _memory_lock()
    yield from _governor()
    yield from _temperature()
    yield from _slowed_down()
    yield from _power_save()
    yield _multicast()
    yield _clock()
    if keys_folder:
        yield from _certificates(keys_folder)


def _versions() -> Finding:
    installed = {extra: _version(name) for extra, name in _EXTRAS.items()}
    extras = ", ".join(f"{extra} {version}" for extra, version in installed.items() if version)
    text = f"sightline {_version('sightline-robot')}, protocol {VERSION}, Python {platform.python_version()}; {extras}"
    return Finding("versions", None, text)


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def _collision() -> Finding:
    """Check for another distribution with this package name: `sightline` on the index is another project."""
    owners = metadata.packages_distributions().get("sightline", ())
    others = sorted(set(owners) - {"sightline-robot"})
    fix = f"pip uninstall {' '.join(others)}, or install Sightline in a separate environment: python3 -m venv .venv"
    return Finding("package names", not others, f"taken by {', '.join(others)}" if others else "no collision", fix)


def _port(port: int, what: str) -> Finding:
    owner = port_owner(port)
    if not owner and listening_inodes({port}):
        fix = "run `sudo sightline doctor`, which names the process"
        return Finding(f"port {port}", None, f"{what}: in use by a process of another user", fix)
    if not owner:
        return Finding(f"port {port}", None, f"{what}: free")
    number = owner.rpartition("(pid ")[2].rstrip(")")
    fix = f"if that is not Sightline: kill {number}, or choose another port with --listen"
    return Finding(f"port {port}", None, f"{what}: in use by {owner}", fix)


def _real_time() -> Finding:
    """Request real-time priority and report the result, because limits and capabilities differ between systems."""
    before = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, before, os.sched_param(0))
    except (OSError, AttributeError):
        fix = "echo \"$USER - rtprio 60\" | sudo tee /etc/security/limits.d/sightline.conf, then log in again"
        return Finding("real-time", False, "not permitted: under load the driver may tick late", fix)
    return Finding("real-time", True, "permitted")


def _memory_lock() -> Finding:
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    ok = soft == resource.RLIM_INFINITY or soft >= 256 << 20 or os.geteuid() == 0
    fix = "echo \"$USER - memlock unlimited\" | sudo tee -a /etc/security/limits.d/sightline.conf, then log in again"
    return Finding("memory lock", ok, "permitted" if ok else f"at most {soft >> 10} kB", fix)


def _governor() -> Iterator[Finding]:
    found = {_text(file) for file in CPUS.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    if found:
        fix = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
        yield Finding("CPU governor", "powersave" not in found, ", ".join(sorted(found)), fix)


def _temperature() -> Iterator[Finding]:
    zones = [_text(file) for file in Path("/sys/class/thermal").glob("thermal_zone*/temp")]
    degrees = [int(text) / 1000 for text in zones if text.lstrip("-").isdigit()]
    if degrees:
        fix = "fit a heat sink or a fan: a hot processor slows down"
        yield Finding("temperature", max(degrees) < _HOT_C, f"{max(degrees):.0f}", fix, "C", f"{_HOT_C:.0f}")
    printed = _output_of("vcgencmd", "get_throttled")
    if printed:
        fix = "use a stronger power supply or cooling; sudo reboot clears the flag"
        yield Finding("throttled", printed.endswith("0x0"), printed, fix)


def _slowed_down() -> Iterator[Finding]:
    """Yield the time that this machine lost to heat, a quota or a host since its start."""
    counts = [_text(file) for file in CPUS.glob("cpu[0-9]*/thermal_throttle/core_throttle_count")]
    hot = sum(int(text) for text in counts if text.isdigit())
    if counts:
        yield Finding("throttled by heat", hot == 0, f"{hot} times since its start", "fit a heat sink or a fan")
    limited = dict(line.split() for line in _text(CGROUP / "cpu.stat").splitlines() if len(line.split()) == 2)
    if "nr_throttled" in limited:
        times, ms = int(limited["nr_throttled"]), int(limited.get("throttled_usec", 0)) // 1000
        fix = "give it a larger share: docker run --cpus, CPUQuota= in the unit"
        yield Finding("throttled by quota", times == 0, f"{times} times, {ms} ms in all", fix)
    ticks = [int(count) for count in _text(PROC_STAT).partition("\n")[0].split()[1:]]
    if len(ticks) > 7 and sum(ticks) > 0:
        share = 100 * ticks[7] / sum(ticks)
        yield Finding("stolen time", share < _STOLEN_PERCENT, f"{share:.1f}",
                      "use a dedicated machine: other virtual machines take this one's processor", "%",
                      f"{_STOLEN_PERCENT:.0f}")


def _power_save() -> Iterator[Finding]:
    for device in sorted(INTERFACES.glob("*/wireless")):
        name = device.parent.name
        printed = _output_of("iw", "dev", name, "get", "power_save")
        fix = f"sudo iw dev {name} set power_save off"
        yield Finding(f"power save {name}", "on" not in printed.lower().split() if printed else None,
                      printed or "unknown: apt install iw", fix)


def _multicast() -> Finding:
    """Check that a multicast datagram returns to its sender. Discovery needs it, explicit endpoints do not."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            receiver.bind(("", MULTICAST_GROUP[1]))
            group = socket.inet_aton(MULTICAST_GROUP[0]) + socket.inet_aton("0.0.0.0")
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
            receiver.settimeout(0.3)
            receiver.sendto(b"sightline doctor", MULTICAST_GROUP)
            receiver.recv(64)
    except OSError as error:
        fix = "none needed: give the endpoint with --connect, which is more reliable"
        return Finding("multicast", None, f"does not work here ({error.strerror or 'no answer'})", fix)
    return Finding("multicast", None, "works on this machine; an access point may still drop it")


def _clock() -> Finding:
    printed = _output_of("timedatectl", "show", "--property=NTPSynchronized", "--value")
    words = {"yes": "synchronized", "no": "not synchronized"}.get(printed, "unknown")
    return Finding("clock", None, f"{words}; only certificates and logs need it, no frame or command does")


def _certificates(folder: str) -> Iterator[Finding]:
    try:
        with needs("secure"):
            from sightline.operator_side.setup import keys

            certificates = keys.look(Path(folder))
    except SightlineError as error:
        yield trouble("certificates", error)
        return
    now = datetime.datetime.now(datetime.UTC)
    for one in certificates:
        problem = one.problem(now)
        fix = f"sightline keys add {folder} {one.role}"
        if not (Path(folder) / "ca.key").exists():
            fix = f"run `sightline keys add DIR {one.role}` where ca.key is, and copy the new files to {folder}"
        if now < one.begins:
            fix = "set the clock of this machine: sudo timedatectl set-ntp true"
        elif one.ends_with_authority and not one.is_foreign:
            fix = f"sightline keys init {folder}-new"
        yield Finding(f"key {one.file.stem}", not problem and one.ends - now > EXPIRES_SOON,
                      problem or f"until {one.ends:%Y-%m-%d}", fix)


def _output_of(*command: str) -> str:
    """Return the output of a system tool; "" if it is missing or fails."""
    if shutil.which(command[0]) is None:
        return ""
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=3).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def _text(file: Path) -> str:
    try:
        return file.read_text().strip()
    except OSError:
        return ""


# --- cameras: the formats that they offer, the rate that they deliver --------------------------------------------


DEVICES: Final = Path("/dev")
_MEASURED_S: Final = 3.0
_ENOUGH: Final = 0.9
_ENUM_FMT: Final = 0xC0405602
"""VIDIOC_ENUM_FMT of the kernel: read and write, 64 bytes, 'V', 2 (linux/videodev2.h)."""
_FORMAT: Final = struct.Struct("III32sII12x")
"""v4l2_fmtdesc: index, type, flags, description, pixel format, bus code."""
_CAPTURE: Final = 1
_MOST_FORMATS: Final = 64
_UNOPENED: Final = {
    errno.EACCES: "sudo usermod -aG video $USER, then log in again",
    errno.EBUSY: "end the other program that uses it: sudo fuser -v",
}


def modes() -> Iterator[Finding]:
    """Yield the formats of each camera device of this machine. A device without formats is skipped."""
    for device in sorted(DEVICES.glob("video[0-9]*")):
        try:
            offered = formats(device)
        except OSError as error:
            fix = _UNOPENED.get(error.errno or 0, "connect it again")
            yield Finding(f"modes {device.name}", False, f"cannot open it: {error.strerror}",
                          f"{fix} {device}" if "fuser" in fix else fix)
            continue
        if offered:
            yield _finding(device, offered)


def _finding(device: Path, offered: list[str]) -> Finding:
    formats, option = ", ".join(offered), f"--set camera.kind=v4l2 --set camera.options.device={device}"
    if "MJPG" in offered or "JPEG" in offered:
        return Finding(f"modes {device.name}", True, f"{formats}; its JPEG passes unchanged (MJPG, the default)")
    if "YUYV" in offered:
        return Finding(f"modes {device.name}", None, f"{formats}; no JPEG: this machine encodes each image",
                       f"sightline robot {option} --set camera.options.format=YUYV")
    return Finding(f"modes {device.name}", False, f"{formats}; neither MJPG nor YUYV", "use another camera")


def formats(device: Path) -> list[str]:
    """Return the four-letter codes of the formats of `device`, its default first. Raises OSError without an answer."""
    handle = os.open(device, os.O_RDWR | os.O_NONBLOCK)
    try:
        return [code for index in range(_MOST_FORMATS) if (code := _format(handle, index))]
    finally:
        os.close(handle)


def _format(handle: int, index: int) -> str:
    query = _FORMAT.pack(index, _CAPTURE, 0, b"", 0, 0)
    try:
        answer = fcntl.ioctl(handle, _ENUM_FMT, query)
    except OSError:  # the end of the list, or the device is not a camera
        return ""
    return read_format(answer)


def read_format(answer: bytes) -> str:
    """Return the format code in the kernel's answer."""
    code: int = _FORMAT.unpack(answer)[4]
    return code.to_bytes(4, "little").decode("ascii", "replace").strip()


def delivered(kind: str, sets: list[str]) -> Finding:
    """Measure the frame rate of a camera against its option `fps`, if it has one, or report its error."""
    from sightline.operator_side.calibrate.local_camera import camera_choice, local_camera
    from sightline.robot_side.plugins import CAMERAS

    stamps_us: list[int] = []
    try:
        wanted = getattr(CAMERAS.load(camera_choice(kind, sets))[1], "fps", None) or 0.0
        with local_camera(kind, sets) as opened:
            begun_s = time.monotonic()
            while time.monotonic() - begun_s < _MEASURED_S:
                if picture := opened.read(0.5):
                    read_jpeg_size(picture.jpeg, MOST_SIDE_PX**2)
                    stamps_us.append(picture.t_us)
    except WireError as error:
        fix = "set its format to MJPG, or let its plug-in encode JPEG"
        return Finding(f"camera {kind}", False, f"an image is not a valid JPEG: {error.detail}", fix)
    except SightlineError as error:
        return trouble(f"camera {kind}", error)
    if len(stamps_us) < 2:
        return Finding(f"camera {kind}", False, "no images", "connect it again, or end the program that uses it")
    if stamps_us[-1] <= stamps_us[0]:
        fix = "set Picture.t_us to the time of the exposure (monotonic_us)"
        return Finding(f"camera {kind}", False, "the time of its images does not advance", fix)
    fps = (len(stamps_us) - 1) / (stamps_us[-1] - stamps_us[0]) * 1e6
    fix = "use more light (a camera exposes longer in the dark), a smaller size or another USB port"
    return Finding(f"camera {kind}", fps >= _ENOUGH * wanted, f"{fps:.1f}", fix, "fps", f"{wanted:g}")
