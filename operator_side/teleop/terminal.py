"""Teleop in a terminal: raw keys, one status line, an end that stops the robot. Shell."""

import os
import select
import shutil
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Final

from sightline.operator_side.client.status import millis, twist_text
from sightline.operator_side.teleop.control import Mode, Teleop
from sightline.operator_side.teleop.gamepad import Gamepad, PadKey
from sightline.protocol.channels import FRAME, REPLY, STATUS, Channel
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.messages import Status
from sightline.protocol.transports.link import LatestSlot, Link, Message

KEYS: Final = """\
      forward            hold a key to drive, let go to stop
   u     i     o
 turn j  k  l turn       k or space   stop
   m     ,     .         q z  both speeds 10 % up, down
       back              w x  linear only    e c  turning only
                         a    hand over to vision; any of u i o j l m , . takes back
Ctrl-C ends it. The first press arms the robot: make sure that it may move.
"""


_SILENT_US: Final = 1_000_000
"""Ten times as long as a robot is silent between two words."""


def live_line(robot: str, teleop: Teleop, width: int, now_us: int) -> str:
    """State, reason, who drives, speeds; cut to the terminal's width, so that it stays one line. Of a robot that has
    fallen silent nothing is known any more."""
    if teleop.report is None:
        text = f"{robot}: {teleop.note or 'nothing heard yet'}"
    elif (silent_us := now_us - teleop.heard_us) > _SILENT_US:
        text = f"{robot}: nothing heard for {silent_us / 1e6:.0f} s; without commands it stops by itself"
    else:
        text = " | ".join(part for part in _parts(robot, teleop, teleop.report.status) if part)
    return text if len(text) <= width else text[: max(0, width - 1)] + "…"


def _parts(robot: str, teleop: Teleop, status: Status) -> list[str]:
    """What matters most comes first: narrow terminals cut the rest."""
    speeds = teleop.speeds
    return [
        f"{robot} {status.state}: {status.reason}",
        "" if teleop.sees else "no picture yet, and a command must cite one: is its camera running?",
        teleop.note,
        _driver(teleop, status),
        twist_text(status.applied),
        f"up to {speeds.linear_mps:.2f} m/s {speeds.angular_rad_s:.2f} rad/s",
        f"frame {millis(status.frame_age_us)}",
    ]


def _driver(teleop: Teleop, status: Status) -> str:
    holder = status.holder
    if holder is None:
        return "nobody drives" if teleop.mode is not Mode.HANDING_OVER else Mode.HANDING_OVER.value
    if holder.session == teleop.session:
        return "you drive"
    return f"{holder.source} drives"


# The terminal around `teleop.Teleop`: keys as they come, a line that follows the robot, an end that stops. Shell.
#
# One thread and one `select`: a key, a frame, a status or a reply wakes it; the transport's callbacks only store.


_TICK_S: Final = 0.01
_SHOW_US: Final = 100_000
_ALL: Final = 4096  # what a terminal holds: a pile of keys must be seen as one
_FAREWELL_S: Final = 0.25
"""Last words are repeated this long, unless the robot answers."""
_PRINT_AGAIN_S: Final = 0.03
_ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def check_terminal() -> None:
    """Raise ConfigError unless keys can be read and shown."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ConfigError("teleop reads keys from a terminal and there is none; over ssh use `ssh -t`")


class Cockpit:
    """Wires a link, a terminal and maybe a gamepad to a `Teleop`."""

    def __init__(self, link: Link, teleop: Teleop, gamepad: Gamepad | None = None) -> None:
        self._link, self._teleop, self._gamepad = link, teleop, gamepad
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._woken, False)
        os.set_blocking(self._wake, False)
        self._slots = [
            (self._slot(FRAME), teleop.on_frame), (self._slot(REPLY), teleop.on_reply),
            (self._slot(STATUS), lambda message: teleop.on_status(message, monotonic_us())),
        ]  # fmt: skip
        self._shown_us = 0
        self._ended = False

    def _slot(self, channel: Channel) -> LatestSlot[Message]:
        slot: LatestSlot[Message] = LatestSlot()

        def store(message: Message) -> None:
            slot.put(message)
            with suppress(BlockingIOError):  # a full pipe wakes as well as one more byte
                os.write(self._wake, b".")

        self._link.subscribe(channel, store)
        return slot

    def run(self) -> None:
        """Until Ctrl-C, a signal, or a terminal that is gone; then zero, and the robot is let go."""
        with _signals(self._end), _cbreak(sys.stdin.fileno()):
            _print(KEYS)
            try:
                while not self._ended:
                    self._turn()
            finally:
                self._say_farewell()
                _print("\n")

    def _end(self, _number: int, _frame: FrameType | None) -> None:
        self._ended = True

    def _turn(self) -> None:
        sources = [sys.stdin.fileno(), self._woken, *([self._gamepad] if self._gamepad else [])]
        ready, _, _ = select.select(sources, [], [], _TICK_S)
        if self._woken in ready:
            _drain(self._woken)
        if sys.stdin.fileno() in ready:
            self._read_keys()
        if self._gamepad in ready and self._gamepad is not None:
            self._read_gamepad(self._gamepad)
        self._take_messages()
        self._publish(self._teleop.messages(monotonic_us()))
        self._show()

    def _read_keys(self) -> None:
        try:
            data = os.read(sys.stdin.fileno(), _ALL)
        except OSError:  # the terminal was closed
            data = b""
        if not data or b"\x04" in data:
            self._ended = True
        self._teleop.on_keys(data.decode("utf-8", "replace"), monotonic_us())

    def _read_gamepad(self, gamepad: Gamepad) -> None:
        try:
            pressed = gamepad.read()
        except HardwareError:
            self._teleop.stop()
            raise
        if PadKey.STOP in pressed:
            self._teleop.stop()
        elif PadKey.HAND_OVER in pressed:
            self._teleop.hand_over(monotonic_us())
        self._teleop.on_stick(gamepad.pad.shares, monotonic_us())

    def _take_messages(self) -> None:
        for slot, handle in self._slots:
            message = slot.take()
            if message is not None:
                handle(message)

    def _publish(self, messages: Iterable[Message]) -> None:
        for message in messages:
            self._link.publish(message.channel, message.header, message.payload, message.source)

    def _show(self) -> None:
        now_us = monotonic_us()
        if now_us - self._shown_us >= _SHOW_US:
            self._shown_us = now_us
            width = shutil.get_terminal_size().columns
            _print("\r\x1b[K" + live_line(self._link.robot, self._teleop, width - 1, now_us))

    def _say_farewell(self) -> None:
        """Zero and release, again until the robot has said that nobody drives, or for a moment."""
        until_s = time.monotonic() + _FAREWELL_S
        while True:
            self._publish(self._teleop.leave())
            time.sleep(_PRINT_AGAIN_S)
            self._take_messages()
            if self._teleop.has_left or time.monotonic() > until_s:
                return


def _drain(pipe: int) -> None:
    with suppress(BlockingIOError):
        os.read(pipe, 4096)


def _print(text: str) -> None:
    """To a terminal that may be gone, or that nobody reads: neither may hold up a command."""
    terminal = sys.stdout.fileno()
    with suppress(OSError):
        if select.select([], [terminal], [], 0)[1]:
            os.write(terminal, text.encode())


@contextmanager
def _cbreak(terminal: int) -> Iterator[None]:
    """Keys at once and unseen; Ctrl-C stays a signal. As it was at the end."""
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal, termios.TCSANOW)
    try:
        yield
    finally:
        with suppress(termios.error):
            termios.tcsetattr(terminal, termios.TCSANOW, before)


@contextmanager
def _signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in _ENDING}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
