"""Teleop in a terminal: raw keys, two status lines, and an end that stops the robot. Shell."""

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
from sightline.operator_side.client.stop import StopSender
from sightline.operator_side.teleop.control import SOURCE, Mode, Teleop
from sightline.operator_side.teleop.gamepad import Gamepad, PadKey
from sightline.protocol.channels import FRAME, REPLY, STATUS, Channel
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError, HardwareError, LinkError, SightlineError
from sightline.protocol.log import printable
from sightline.protocol.messages import LeaseHolder, Status
from sightline.protocol.transports.link import LatestSlot, Link, Message

_SILENT_US: Final = 1_000_000
"""Silence after which the state is unknown: ten times the period of a robot's status."""


def live_lines(robot: str, teleop: Teleop, width: int, now_us: int) -> tuple[str, str]:
    """Format two lines, each cut to `width`: state and reason; driver, frame age, wheels and speeds.

    The state of a silent robot is unknown, so it is not shown.
    """
    first, second = _lines(robot, teleop, now_us)
    return _cut(first, width), _cut(second, width)


def _lines(robot: str, teleop: Teleop, now_us: int) -> tuple[str, str]:
    if teleop.report is None:
        return f"{robot}: {teleop.note or 'no status yet; `sightline robots` lists the robots'}", ""
    silent_us = now_us - teleop.received_us
    if silent_us > _SILENT_US:
        return f"{robot}: no status for {silent_us / 1e6:.0f} s; without commands the robot stops", teleop.note
    status, speeds = teleop.report.status, teleop.speeds
    no_frame = "" if teleop.has_frame else "no image yet, and each command must cite one; check the camera"
    first = (f"{robot} {status.state}: {status.reason}", no_frame, teleop.note)
    second = (
        _driver(teleop, status), f"frame {millis(status.frame_age_us)}", twist_text(status.applied),
        f"up to {speeds.linear_mps:.2f} m/s {speeds.angular_rad_s:.2f} rad/s",
    )  # fmt: skip
    return " | ".join(part for part in first if part), " | ".join(second)


def _cut(line: str, width: int) -> str:
    line = printable(line)
    return line if len(line) <= width else line[: max(0, width - 1)] + "…"


def _driver(teleop: Teleop, status: Status) -> str:
    holder = status.holder
    if holder is None:
        return "no driver" if teleop.mode is not Mode.HANDING_OVER else Mode.HANDING_OVER.value
    if holder == LeaseHolder.of(SOURCE, teleop.session):
        return "you drive"
    return f"{holder.source} drives"


# --- the terminal ------------------------------------------------------------------------------------------------
#
# One thread and one `select`: a key, a frame, a status or a reply wakes it. Callbacks of the transport only store data.


_TICK_S: Final = 0.01
_SHOW_US: Final = 100_000
_ALL: Final = 4096  # size of a terminal's buffer, so that one read returns all late keys
_LEAVE_S: Final = 0.25
"""Time for which the last messages are repeated, unless the robot answers."""
_PROVE_STOP_S: Final = 1.5
"""Time after the end for which an unproven STOP is repeated."""
_LEAVE_PERIOD_S: Final = 0.03
_ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP)  # a suspended teleop reads no STOP key


def check_terminal() -> None:
    """Raise ConfigError unless stdin and stdout are a terminal."""
    if not all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stdout)):
        raise ConfigError("teleop needs a terminal to read keys; over ssh use `ssh -t`")


class Cockpit:
    """Connects a link, a terminal and optionally a gamepad to a `Teleop`."""

    def __init__(
        self, link: Link, teleop: Teleop, send_stop: Callable[[], StopSender], gamepad: Gamepad | None = None
    ) -> None:
        """Subscribe to the robot.

        Args:
            link: open link with the role of teleop.
            teleop: the session.
            send_stop: starts the sending of STOP datagrams.
            gamepad: an open gamepad.
        """
        self._link, self._teleop, self._gamepad = link, teleop, gamepad
        self._send_stop = send_stop
        self._stop_sender: StopSender | None = None
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
            with suppress(BlockingIOError):  # a full pipe wakes the thread, too
                os.write(self._wake, b".")

        self._link.subscribe(channel, store)
        return slot

    def run(self) -> None:
        """Drive until Q, Ctrl-C, a signal or the end of the terminal. Then command zero and release the robot.

        Raises:
            LinkError: the operator sent STOP, and it is not proven.
        """
        with _signals(self._end), _cbreak(sys.stdin.fileno()), _screen() as self._print:
            self._print(self._teleop.layout.help)
            try:
                while not self._ended:
                    self._turn()
            finally:
                self._leave()
                if self._stop_sender is not None:
                    self._stop_sender.close()
                self._print("\n\n")
                if self._teleop.is_stopping:  # more important than an error that ended the drive
                    raise LinkError(f"robot '{self._link.robot}' did not confirm STOP; cut its power by hand")

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
        self._stop_by_datagrams()
        self._publish(self._teleop.messages(monotonic_us()))
        self._show()

    def _stop_by_datagrams(self) -> None:
        """Send STOP datagrams while a STOP is not proven. Their answers prove it, too."""
        if self._stop_sender is not None and self._stop_sender.is_stopped:
            self._teleop.on_stopped()
        if self._teleop.is_stopping and self._stop_sender is None:
            try:
                self._stop_sender = self._send_stop()
            except (SightlineError, OSError, RuntimeError) as error:  # the link still sends STOP
                self._teleop.note = f"STOP is not confirmed, repeating; {error}"
        elif not self._teleop.is_stopping and self._stop_sender is not None:
            self._stop_sender.close()
            self._stop_sender = None

    def _read_keys(self) -> None:
        try:
            data = os.read(sys.stdin.fileno(), _ALL)
        except OSError:  # the terminal is closed
            data = b""
        self._teleop.on_keys(data.decode("utf-8", "replace"), monotonic_us())
        self._ended |= not data or b"\x04" in data or self._teleop.wants_to_quit

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
            first, second = live_lines(self._link.robot, self._teleop, width - 1, now_us)
            self._print(f"\r\x1b[K{first}\n\x1b[K{second}\r\x1b[1A")  # and back up, to redraw both lines in place

    def _leave(self) -> None:
        """Command zero and release the lease, until the robot confirms release and STOP, or for a short time."""
        began_s = time.monotonic()
        while True:
            self._publish(self._teleop.leave())
            time.sleep(_LEAVE_PERIOD_S)
            self._take_messages()
            self._stop_by_datagrams()
            longest_s = _PROVE_STOP_S if self._teleop.is_stopping else _LEAVE_S
            if self._teleop.has_left or time.monotonic() - began_s > longest_s:
                return


def _drain(pipe: int) -> None:
    with suppress(BlockingIOError):
        os.read(pipe, 4096)


@contextmanager
def _screen() -> Iterator[Callable[[str], None]]:
    """Yield a function that writes to the terminal. A missing or full terminal must not delay a command.

    The terminal is opened again, because other programs share the mode of its first descriptor.
    """
    try:
        screen = os.open(os.ttyname(sys.stdout.fileno()), os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:  # in a container the terminal may have no name
        screen = os.dup(sys.stdout.fileno())

    def write(text: str) -> None:
        with suppress(OSError):
            if select.select([], [screen], [], 0)[1]:
                os.write(screen, text.encode())

    try:
        yield write
    finally:
        os.close(screen)


@contextmanager
def _cbreak(terminal: int) -> Iterator[None]:
    """Read keys immediately and without echo; Ctrl-C stays a signal. Restore the terminal at the end.

    Keys before the start are discarded, because nothing was shown yet. Keys at the end are, too, so that the shell does
    not get them.
    """
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal, termios.TCSANOW)  # TCSAFLUSH would wait for a terminal that does not read its output
    termios.tcflush(terminal, termios.TCIFLUSH)
    try:
        yield
    finally:
        with suppress(termios.error):
            termios.tcflush(terminal, termios.TCIFLUSH)
            termios.tcsetattr(terminal, termios.TCSANOW, before)


@contextmanager
def _signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in _ENDING}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
