"""A peer of the robot: the vision service, a scripted driver with its attacks, or an operator. Shell.

    python -m sightline.evaluation.faults.peer OPTIONS_AS_JSON

It behaves normally until SIGUSR1, then as `fault` states.
"""

import asyncio
import importlib
import itertools
import os
import re
import secrets
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType
from typing import Any, Final, Literal, NamedTuple

from sightline.evaluation.faults.evidence import FLOOD_AT_LEAST, GOOD, INJECTED, REQUESTED, EventLog
from sightline.evaluation.faults.vision_peer import run_shared, run_vision
from sightline.operator_side.client.requests import SOURCE as OPERATOR_SOURCE
from sightline.operator_side.client.requests import Operator
from sightline.operator_side.client.stop import stop_robot
from sightline.protocol.channels import ACK, CHANNELS, FRAME, MAX_HEADER_BYTES, REQUEST, STATUS, TWIST, Channel, key_for
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.config import Config
from sightline.protocol.errors import SightlineError
from sightline.protocol.messages import (
    MAX_INTEGER,
    AnswerHeader,
    Echo,
    FrameHeader,
    Request,
    RequestHeader,
    Stamp,
    State,
    Twist,
    Verb,
)
from sightline.protocol.proof import NO_PROOF, ProofChain
from sightline.protocol.text import format_twist
from sightline.protocol.transports.endpoints import parse_websocket_endpoint
from sightline.protocol.transports.link import LatestSlot, Message
from sightline.protocol.transports.open import open_link
from sightline.protocol.transports.stop_datagram import StopRequests
from sightline.protocol.transports.stop_port import stop_secret_file
from sightline.protocol.transports.tokens import DriverToken
from sightline.protocol.transports.websocket.legacy_text import encode_picture
from sightline.protocol.transports.zenoh.link import ZenohLink, declare_token, open_zenoh
from sightline.protocol.transports.zenoh.session import open_session
from sightline.robot_side.kinematics import DiffDriveConfig, wheel_speeds
from sightline.robot_side.safety.limits import TICK_US, SafetyConfig
from sightline.sim.bus import SimCamera, SimDrive, SimSocketConfig

Role = Literal["vision", "shared", "driver", "guest", "legacy", "operator", "stop"]


class PeerOptions(Config):
    """The task of one peer."""

    role: Role
    endpoint: str
    web_endpoint: str = ""
    """Endpoint of a guest or of a legacy robot. Its query names the text format."""
    sockets: str = ""
    """Of a legacy robot: folder of the simulation's sockets. `fault` names its library."""
    event_log: Path
    robot: str = "r1"
    source: str = "vision"
    """The role that a scripted driver takes on the wire."""
    fault: str = ""
    config: Path | None = None
    """Configuration file of the vision service."""
    linear_mps: float = 0.5
    angular_rad_s: float = 0.4
    recording: Path | None = None
    """A driver writes its messages here; a replay reads them."""
    secure: str = ""
    """Folder of keys, and the role of the certificate, if it differs from `source`."""
    certificate: str = ""
    session: str = ""
    """Session to drive with; random if empty."""
    share: str = ""
    """Name of a service that shares robots, or of a scripted driver with a token."""
    seconds: float | None = None
    """Time after which the peer ends by itself."""


class Trigger:
    """Becomes set by SIGUSR1."""

    def __init__(self) -> None:
        self.pulled = threading.Event()
        signal.signal(signal.SIGUSR1, self._pull)

    def _pull(self, _number: int, _frame: FrameType | None) -> None:
        self.pulled.set()


def main() -> int:
    """Run one peer; returns its exit code."""
    options = PeerOptions.model_validate_json(sys.argv[1])
    trigger, event_log = Trigger(), EventLog(options.event_log)
    return ROLES[options.role](options, trigger.pulled, event_log)


# A scripted driver: answers each frame with one twist, citing it properly, until its fault is triggered. Shell.

KEPT: Final = 256
WAIT_S: Final = 0.05
_REQUESTS_EVERY: Final = 15
"""Commands between the requests of a driver that records."""


class SentMessage(NamedTuple):
    """A sent message, for a replay."""

    channel: Channel
    header: bytes
    payload: bytes


def read_recording(path: Path) -> list[SentMessage]:
    """Read the messages of a recording, whose last line may still be incomplete."""
    rows = [line.split() for line in path.read_text("ascii").split("\n")[:-1]]
    return [SentMessage(CHANNELS[name], bytes.fromhex(header), bytes.fromhex(text)) for name, header, text in rows]


class Script:
    """The context of an attack: the link, the newest frame, all sent messages."""

    def __init__(
        self, options: "PeerOptions", link: ZenohLink, event_log: EventLog, proofs: ProofChain,
        withdraw: Callable[[], None] = lambda: None,
    ) -> None:
        self.options, self.link, self.proofs, self.withdraw = options, link, proofs, withdraw
        self.session = options.session or secrets.token_hex(4)
        self.seq = self._requests = 0
        self.sent: deque[SentMessage] = deque(maxlen=KEPT)
        self.twist = Twist(linear_mps=options.linear_mps, angular_rad_s=options.angular_rad_s)
        self._event_log = event_log
        self._frames: LatestSlot[Message] = link.latest(FRAME)
        self._reports: LatestSlot[Message] = link.latest(STATUS)
        self._recording = options.recording.open("a") if options.recording and options.fault != "replay" else None

    def frame(self, wait_s: float = WAIT_S) -> FrameHeader | None:
        """Return the header of the newest unread frame. Waits briefly for one."""
        message = self._frames.take(wait_s)
        return decode(FrameHeader, message.header) if message else None

    def answer(self, frame: FrameHeader, **changes: object) -> AnswerHeader:
        """Return the header of a command that answers `frame`; `changes` falsify its fields."""
        cited = {"session": frame.session, "seq": frame.seq, "t_us": frame.t_us, **changes}
        echo = Echo.model_validate({"channel": "frame", **cited})
        self.seq += 1
        proof = self.proofs.next()._asdict()
        return AnswerHeader(source=self.options.source, session=self.session, seq=self.seq, echo=echo, **proof)

    def drive(self, frame: FrameHeader, twist: Twist | None = None) -> None:
        """Send a good command."""
        header, text = encode(self.answer(frame)), format_twist(twist or self.twist)
        self._event_log.note(GOOD, frame.t_us)
        self._send(TWIST, header, text)
        if self._recording and self.seq % _REQUESTS_EVERY == 0 and (report := self._reports.take()):
            self._request_all(Echo.of(decode(Stamp, report.header)))

    def _request_all(self, echo: Echo) -> None:
        """Send each request that a replay could use."""
        for verb in (Verb.ACQUIRE, Verb.ARM, Verb.RESET):
            self._requests += 1
            header = RequestHeader(source=self.options.source, session=self.session, seq=self._requests, echo=echo,
                                   **self.proofs.next()._asdict())
            self._send(REQUEST, encode(header), encode(Request(id=self._requests, verb=verb)))

    def _send(self, channel: Channel, header: bytes, payload: bytes) -> None:
        self.sent.append(SentMessage(channel, header, payload))
        if self._recording:
            self._recording.write(f"{channel.name} {header.hex()} {payload.hex()}\n")
            self._recording.flush()
        self.link.publish(channel, header, payload, self.options.source)

    def replay(self, message: SentMessage) -> None:
        """Send a recorded message again."""
        self._event_log.note(INJECTED)
        self.link.publish(*message, self.options.source)

    def attack(self, header: AnswerHeader | bytes, text: bytes | None = None) -> None:
        """Send a command that must not move the wheels."""
        data = header if isinstance(header, bytes) else encode(header)
        self._event_log.note(INJECTED)
        self.link.publish(TWIST, data, format_twist(self.twist) if text is None else text, self.options.source)

    def injected(self) -> None:
        """Record an injection other than by `attack`."""
        self._event_log.note(INJECTED)

    @property
    def key(self) -> str:
        """Return the exact key of this driver's twists."""
        return key_for(self.link.robot, TWIST, self.options.source)


def _declare_driver(options: "PeerOptions", proofs: ProofChain, ending: ExitStack) -> Callable[[], None]:
    """Declare the token of a driver that has one. Returns the function that ends it."""
    if not options.share:
        return lambda: None
    session = ending.enter_context(open_session((), [options.endpoint], 5.0))
    return declare_token(session, DriverToken(options.robot, options.share, proofs.token))


def run_driver(options: "PeerOptions", pulled: threading.Event, event_log: EventLog) -> int:
    """Drive, then do `options.fault`, forever or for `options.seconds`."""
    end_s = time.monotonic() + options.seconds if options.seconds else float("inf")
    proofs = ProofChain(secrets.token_bytes)
    with ExitStack() as ending:
        withdraw = _declare_driver(options, proofs, ending)  # first: the robot must know it before the first command
        link = ending.enter_context(open_zenoh(
            options.robot, connect=[options.endpoint], role=options.certificate or options.source, timeout_s=15,
            secure=options.secure))
        script = Script(options, link, event_log, proofs, withdraw)
        while not (pulled.is_set() and options.fault) and time.monotonic() < end_s:
            frame = script.frame()
            if frame is not None:
                script.drive(frame)
        if options.fault:
            ATTACKS[options.fault](script)
    return 0


# A client of the legacy protocol, which names no image. Shell.

GUEST_HZ: Final = 20


def run_guest(options: "PeerOptions", pulled: threading.Event, event_log: EventLog) -> int:
    """Vary the command; after the trigger repeat one. Commands count while the robot may apply them."""
    ends_us = SafetyConfig().guest_unchanged_ms * 1000
    with open_link(options.robot, connect=[options.web_endpoint], role="guest", timeout_s=15) as link:
        repeats_since_us = None
        for number in itertools.count():
            if pulled.is_set() and repeats_since_us is None:
                repeats_since_us = monotonic_us()
            change = 0.0 if repeats_since_us else 0.001 * (number % 2)
            twist = Twist(linear_mps=options.linear_mps - change, angular_rad_s=options.angular_rad_s - change)
            if repeats_since_us:
                event_log.note(INJECTED)
            if not repeats_since_us or monotonic_us() - repeats_since_us < ends_us:
                event_log.note(GOOD, monotonic_us())
            link.publish(TWIST, b"", format_twist(twist))
            time.sleep(1 / GUEST_HZ)
    return 0


# A legacy robot in the simulation: its motors latch, it has no watchdog, and its WebSocket is a third-party library.


_TWO_NUMBERS: Final = re.compile(r"(-?[0-9.]+)-(-?[0-9.]+)")
_IMAGE_S: Final = 0.05


class LegacyRobot:
    """Reads text as legacy robots do: invalid text raises an error, and the library closes the connection."""

    def __init__(self, options: "PeerOptions", event_log: EventLog) -> None:
        config = SimSocketConfig(socket_dir=options.sockets)
        self._drive, self._camera, self._event_log = SimDrive(config), SimCamera(config), event_log
        self._form = options.web_endpoint.partition("?")[2]
        self._twist = Twist(linear_mps=0.0, angular_rad_s=0.0)
        threading.Thread(target=self._turn_wheels, name="wheels", daemon=True).start()

    def _turn_wheels(self) -> None:
        while True:
            self._drive.set(*wheel_speeds(DiffDriveConfig(), self._twist))
            time.sleep(TICK_US / 1e6)

    def image(self) -> str:
        """Return the next image as text."""
        picture = self._camera.read(1.0)
        return encode_picture(picture.jpeg if picture else b"").decode("ascii")

    def on_text(self, text: str) -> None:
        """Apply a command until the next one comes."""
        linear_mps, angular_rad_s = self._read(text)
        self._event_log.note(GOOD, monotonic_us())
        self._twist = Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)

    def _read(self, text: str) -> tuple[float, float]:
        if self._form == "boxes":
            return self._toward(text)
        if not self._form:
            linear, angular = text.split("|")
        elif self._form.endswith("nonnegative"):
            linear, angular = text.split("-")
        elif match := _TWO_NUMBERS.fullmatch(text):
            linear, angular = reversed(match.groups()) if "swapped" in self._form else match.groups()
        else:
            raise ValueError(text)
        return float(linear), float(angular)

    @staticmethod
    def _toward(text: str) -> tuple[float, float]:
        boxes = [tuple(map(float, box.split(","))) for box in text.split("-") if box]
        if not boxes:
            return 0.0, 0.0
        _, left, _, right = max(boxes, key=lambda box: box[3] - box[1])
        return 0.35, 2.0 * (0.5 - (left + right) / 2)


def _serve_article(module: Any, robot: LegacyRobot, port: int) -> None:
    """Serve with `SimpleWebSocketServer`, the library of the legacy robots."""
    clients: list[Any] = []

    class Hub(module.WebSocket):  # type: ignore[misc]
        def handleMessage(self) -> None:  # noqa: N802
            robot.on_text(self.data)

        def handleConnected(self) -> None:  # noqa: N802
            clients.append(self)

        def handleClose(self) -> None:  # noqa: N802
            clients.remove(self)

    def film() -> None:
        while True:
            text = robot.image()
            for client in list(clients):
                with suppress(Exception):  # closed in the meantime
                    client.sendMessage(text)
            time.sleep(_IMAGE_S)

    threading.Thread(target=film, name="images", daemon=True).start()
    module.SimpleWebSocketServer("127.0.0.1", port, Hub).serveforever()


async def _film_to(robot: LegacyRobot, send: Callable[[str], Awaitable[None]]) -> None:
    while True:
        await send(robot.image())
        await asyncio.sleep(_IMAGE_S)


def _serve_websockets(_module: Any, robot: LegacyRobot, port: int) -> None:
    async def handler(client: Any) -> None:
        filming = asyncio.ensure_future(_film_to(robot, client.send))
        try:
            async for text in client:
                robot.on_text(text)
        finally:
            filming.cancel()

    async def main() -> None:
        async with importlib.import_module("websockets.asyncio.server").serve(handler, "127.0.0.1", port):
            await asyncio.Future()

    asyncio.run(main())


def _serve_uvicorn(module: Any, robot: LegacyRobot, port: int) -> None:
    async def app(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "websocket":
            return
        await receive()
        await send({"type": "websocket.accept"})
        filming = asyncio.ensure_future(_film_to(robot, lambda text: send({"type": "websocket.send", "text": text})))
        try:
            while (event := await receive())["type"] == "websocket.receive":
                robot.on_text(event["text"])
        finally:
            filming.cancel()

    module.run(app, host="127.0.0.1", port=port, log_level="critical", lifespan="off")


LEGACY_LIBRARIES: Final[dict[str, Callable[[Any, LegacyRobot, int], None]]] = {
    "SimpleWebSocketServer": _serve_article, "websockets": _serve_websockets, "uvicorn": _serve_uvicorn,
}


def run_legacy_robot(options: "PeerOptions", _pulled: threading.Event, event_log: EventLog) -> int:
    """Serve forever with the library that `fault` names."""
    robot = LegacyRobot(options, event_log)
    print("robot r1: on", flush=True)
    port = parse_websocket_endpoint(options.web_endpoint).port
    LEGACY_LIBRARIES[options.fault](importlib.import_module(options.fault), robot, port)
    return 0


# Commands of a scripted driver: those that must not move the wheels, and good ones that must do no harm. Shell.

LATE_S: Final = 0.5
HOUR_US: Final = 3_600_000_000
FLOOD_HZ: Final = 10_000
FLOOD_BATCH: Final = 50
FLOOD_S: Final = 3.0
REVERSE_S: Final = 0.02
HUGE_BYTES: Final = 10_000_000
MALFORMED: Final = (
    b"nan|0", b"0.5|nan", b"inf|0", b"-inf|0", b"1e400|0", b"1_0|0", "０.５|０".encode(), b"", b"|", b"0.5",
    b"0.5|0|0", b" 0.5|0", b"0.5|0\n", b"0.5,0", b"0x1p-1|0", b"\xff\xfe|\x00", bytes(range(32)),
)
OVERSIZED: Final = (b"0" * 63 + b"|0", b"0.5|" + b"0" * 253, b"0.5|" + b"0" * HUGE_BYTES)


def _frames(script: Script) -> Iterator[FrameHeader]:
    """Yield every new frame, otherwise the last one 20 times a second: a sender of invalid commands receives few."""
    last: FrameHeader | None = None
    while True:
        last = script.frame() or last
        if last is not None:
            yield last


def late(script: Script) -> None:
    """Send each command half a second after its frame, or later if no newer frame is as old."""
    waiting: deque[FrameHeader] = deque(maxlen=64)
    while True:
        frame = script.frame()
        if frame is not None:
            waiting.append(frame)
        while len(waiting) > 1 and _is_late(waiting[1]):
            waiting.popleft()
        if waiting and _is_late(waiting[0]):
            script.attack(script.answer(waiting[0]))


def _is_late(frame: FrameHeader) -> bool:
    return monotonic_us() - frame.t_us > LATE_S * 1e6


def replay(script: Script) -> None:
    """Replay earlier messages of this session or of a recording, repeatedly: the first and the newest ones."""
    recording = script.options.recording
    while True:
        messages = read_recording(recording) if recording else list(script.sent)
        for message in (*messages[:50], *messages[-50:]):
            script.replay(message)
            time.sleep(0.005)


def turn_round(script: Script) -> None:
    """Drive the other way from now on."""
    forward = Twist(linear_mps=-script.twist.linear_mps, angular_rad_s=0.0)
    for frame in _frames(script):
        script.drive(frame, forward)


def never_issued(script: Script) -> None:
    """Cite frames that the robot never sent."""
    for frame in _frames(script):
        script.attack(script.answer(frame, seq=frame.seq + 1000))


def from_future(script: Script) -> None:
    """Cite the number of a frame with a future time, and the next frame before it is issued."""
    for frame in _frames(script):
        script.attack(script.answer(frame, t_us=frame.t_us + 1_000_000))
        script.attack(script.answer(frame, seq=frame.seq + 1, t_us=frame.t_us + 33_333))


def wrapped(script: Script) -> None:
    """Send the highest number, and numbers from zero again."""
    for count, frame in enumerate(_frames(script)):
        script.seq = MAX_INTEGER - 1 if count % 2 else min(count, 10) - 1
        script.attack(script.answer(frame))

def copied(script: Script) -> None:
    """Send commands in the driver's name: with another chain of proofs, without one, and with a far number."""
    for frame in _frames(script):
        header = script.answer(frame)
        for changes in ({}, {"proof": None, "next_proof": None}, {"seq": header.seq + 2**19}):
            script.attack(header.model_copy(update=changes))


def copied_requests(script: Script) -> None:
    """Send requests in the driver's name, each citing the newest status: with a foreign proof, and without one."""
    reports = script.link.latest(STATUS)
    for number in itertools.count(1):
        report = reports.take(1.0)
        if report is None:
            continue
        echo = Echo.of(decode(Stamp, report.header))
        for verb in (Verb.RELEASE, Verb.ACQUIRE, Verb.ARM, Verb.RESET):
            for proof in (script.proofs.next(), NO_PROOF):
                header = RequestHeader(source=script.options.source, session=script.session, seq=number, echo=echo,
                                       **proof._asdict())
                script.injected()
                payload = encode(Request(id=number, verb=verb))
                script.link.publish(REQUEST, encode(header), payload, script.options.source)


def future_frames(script: Script) -> None:
    """Send frames in the robot's name: the largest time, an hour ahead, and the largest number."""
    with open_session((), [script.options.endpoint], 5.0) as third_party:
        for frame in _frames(script):
            for changes in ({"t_us": MAX_INTEGER}, {"t_us": frame.t_us + HOUR_US}, {"seq": MAX_INTEGER}):
                header = encode(frame.model_copy(update=changes))
                script.injected()
                third_party.put(key_for(script.link.robot, FRAME), b"no image", attachment=header)
            time.sleep(0.05)


def malformed(script: Script) -> None:
    """Send every text that is not a twist, with a valid header."""
    with open_session((), [script.options.endpoint], 5.0) as third_party:
        for frame in _frames(script):
            for text in MALFORMED:
                script.attack(script.answer(frame), text)
            for text in OVERSIZED:  # the link rejects these
                script.injected()
                third_party.put(script.key, text, attachment=encode(script.answer(frame)))
            script.attack(b"{" * MAX_HEADER_BYTES)
            time.sleep(0.1)


def flood(script: Script) -> None:
    """Send one old command at 10 kHz, or as fast as this process can."""
    _, header, text = script.sent[0]
    started_s, batches = time.monotonic(), 0
    while time.monotonic() - started_s < FLOOD_S or batches * FLOOD_BATCH < FLOOD_AT_LEAST:
        for _ in range(FLOOD_BATCH):
            script.attack(header, text)
        batches += 1
        time.sleep(max(0.0, started_s + batches * FLOOD_BATCH / FLOOD_HZ - time.monotonic()))


def reversal(script: Script) -> None:
    """Drive full speed ahead and back at 50 Hz, citing properly; then go silent."""
    end_s, sign = time.monotonic() + 2.0, 1.0
    frame = next(_frames(script))
    while time.monotonic() < end_s:
        frame, sign = script.frame(0.0) or frame, -sign
        script.drive(frame, Twist(linear_mps=0.5 * sign, angular_rad_s=0.0))
        script.injected()
        time.sleep(REVERSE_S)


def heartbeat(script: Script) -> None:
    """Acknowledge every frame and stay connected without commands."""
    for frame in _frames(script):
        script.injected()
        script.link.publish(ACK, encode(script.answer(frame)), b"", script.options.source)


def thousand(script: Script) -> None:
    """Send a thousand good commands quickly, then continue as before."""
    frame = next(_frames(script))
    for _ in range(1000):
        frame = script.frame(0.0) or frame
        script.attack(script.answer(frame))
        time.sleep(0.001)
    for frame in _frames(script):
        script.attack(script.answer(frame))


def after_token(script: Script) -> None:
    """End the token of this driver. Repeat its last twist, and send newer ones of its session on young frames."""
    last = script.sent[-1]
    script.withdraw()
    for frame in _frames(script):
        script.replay(last)
        script.attack(script.answer(frame))


ATTACKS: Final[dict[str, Callable[[Script], None]]] = {
    attack.__name__: attack
    for attack in (late, replay, never_issued, from_future, wrapped, malformed, flood, reversal, heartbeat, thousand,
                   copied, copied_requests, future_frames, turn_round, after_token)
}


# An operator as a process: requests STOP (then reset), or the presence of the robot. Shell.

def run_operator(options: "PeerOptions", pulled: threading.Event, event_log: EventLog) -> int:
    """Wait for the trigger, send the request, and print the reply."""
    with open_zenoh(options.robot, connect=[options.endpoint], role=OPERATOR_SOURCE, timeout_s=15) as link:
        operator = Operator(link)
        operator.wait_report(10.0)
        print("person ready", flush=True)
        pulled.wait()
        if options.fault == "lateness":
            print(f"late by {operator.wait_report(10.0).status.tick_late_max_us} us", flush=True)
            return 0
        event_log.note(REQUESTED)
        event_log.note(INJECTED)
        if options.fault == "reset":  # before the wheels are at zero
            operator.stop(lambda: None, is_proven=lambda: (
                operator.report is not None and operator.report.status.state is State.STOPPED))
            reply = operator.request(Verb.RESET)
            print(f"reset {reply.ok}: {reply.detail}", flush=True)
            return 0
        status = operator.stop(lambda: None)
        print(f"state {status and status.state}", flush=True)
    return 0


# A new operator: runs the code of `sightline stop` in this process, so that its first packet is logged. Shell.

def run_stop(options: "PeerOptions", pulled: threading.Event, event_log: EventLog) -> int:
    """Wait for the trigger, stop the robot, and exit as the command does. A recording gets the datagrams."""
    datagrams, sent = StopRequests.datagrams, 0

    def noted(self: StopRequests) -> list[bytes]:
        nonlocal sent
        if not sent:
            event_log.note(REQUESTED)
        made = datagrams(self)
        sent += len(made)
        if options.recording is not None:
            with options.recording.open("a") as recording:
                recording.writelines(f"{data.hex()}\n" for data in made)
        return made

    StopRequests.datagrams = noted  # type: ignore[method-assign]
    secret_file = stop_secret_file(options.secure) if options.secure else ""
    print("stop ready", flush=True)
    pulled.wait()
    code = 0
    try:
        print(stop_robot(options.robot, [options.endpoint], options.secure, secret_file, lambda: None), flush=True)
    except SightlineError as error:
        code = error.exit_code
        print(error, flush=True)
    print(f"stop ended with {code} after {sent} datagrams", flush=True)
    os._exit(code)  # the link may still be opening


ROLES: Final[dict[Role, Callable[[PeerOptions, threading.Event, EventLog], int]]] = {
    "vision": lambda options, pulled, event_log: run_vision(
        options.endpoint, options.config, options.fault, pulled, event_log),
    "shared": lambda options, _pulled, event_log: run_shared(
        options.endpoint, options.share, options.linear_mps, options.angular_rad_s, event_log),
    "driver": run_driver, "guest": run_guest, "legacy": run_legacy_robot, "operator": run_operator, "stop": run_stop,
}

if __name__ == "__main__":
    sys.exit(main())
