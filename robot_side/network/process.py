"""The camera loop of the network process and its threads. Shell."""

import fcntl
import logging
import os
import signal
import socket
import struct
import sys
import threading
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from typing import Final

from sightline.protocol.channels import ACK, FRAME, REQUEST, TWIST
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.errors import HardwareError, SightlineError, WireError
from sightline.protocol.log import RepeatLimiter, count_fault, error_line, fault_text, faults, report_fault, start_log
from sightline.protocol.messages import CameraModel
from sightline.protocol.transports.flood_limits import limit_floods
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import Relay, open_link
from sightline.protocol.transports.security import ROBOT_ROLE, date_problem
from sightline.robot_side import pipe as ipc
from sightline.robot_side.config import PluginChoice
from sightline.robot_side.driver.supervision import EXIT_SIGNALS
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.pipe import CAMERA_EXIT, NetworkEnd, NetworkSetup
from sightline.robot_side.plugins import CAMERAS
from sightline.robot_side.ports import Camera, Picture, check_image

_log: Final = logging.getLogger(__name__)

_GET_ADDRESS: Final = 0x8915  # SIOCGIFADDR of linux/sockios.h
_ANYWHERE: Final = ("/0.0.0.0:", "/[::]:")


def reachable_endpoints(endpoints: Sequence[str]) -> list[str]:
    """List the addresses of endpoints that listen on every interface."""
    open_ends = [(endpoint, anywhere) for endpoint in endpoints for anywhere in _ANYWHERE if anywhere in endpoint]
    here = own_addresses() if open_ends else []
    return [endpoint.replace(anywhere, f"/{address}:") for endpoint, anywhere in open_ends for address in here]


def own_addresses() -> list[str]:
    """List the IPv4 address of every interface, without loopback."""
    found: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as query:
        for _, name in socket.if_nameindex():
            with suppress(OSError):  # an interface without an address
                reply = fcntl.ioctl(query.fileno(), _GET_ADDRESS, struct.pack("256s", name.encode()))
                found.append(socket.inet_ntoa(reply[20:24]))
    return [address for address in dict.fromkeys(found) if not address.startswith("127.")]


# The network process: owns camera and link, forwards raw commands to the driver, publishes its messages. Shell.
#
# `sightline.robot_side.pipe` starts it with its ends of two socket pairs. It ends when the first one closes.


_STREAM_STATUS_US = 200_000
_CAMERA_TIMEOUT_S = 0.2
_CAMERA_RETRY_S = 0.5
_CHECK_STEP_US = 200_000
_RESTARTED = "; its process was started again"
_LONGEST_NAP_S = 0.1
_SHORT_NAP_S = 0.01
_MAX_WAITING_TOKENS = 64  # security limit
_BETWEEN_MODELS_US = 200_000
_AWAKE_US = 1_000_000  # after a driver token appeared or ended, because its subscription to frames changes soon
_LEAVES_WITHIN_S = 3.0
_OPENS_WITHIN_S = 20.0


class NetworkProcess:
    """Runs the camera loop (main thread), the pipe of the driver (a thread) and the callbacks of the link."""

    def __init__(self, setup: NetworkSetup, driver: NetworkEnd, link: Link, camera: Camera | None) -> None:
        """Create it. Without a `camera` the camera loop opens the camera."""
        self._network_end = driver
        self._link = link
        self.camera = camera
        self._setup = setup
        config = setup.config
        self._network_core = NetworkCore(config.stream, setup.session, setup.first_seq, config.max_frame_bytes)
        self._lock = threading.Lock()
        self._credit = threading.Event()
        self._camera_fault = setup.camera_fault
        self._no_image_since_us = 0
        """Start of the wait for an image that is due; 0 if no image is due. Another thread checks it."""
        self._watched_since_us = self._waited_us = self._checked_us = 0
        self._awake_until_us = self._announced_us = 0
        self._tokens: dict[str, bool] = {}
        """Driver tokens that wait for room in the pipe -> True if present. The end of a token ends a lease."""
        self._faults_reported: Counter[str] = Counter()
        self._rejection_limiter = RepeatLimiter()
        self._rejected_acks: Counter[str] = Counter()
        self._rejected_reported: Counter[str] = Counter()
        self.running = True

    def run(self) -> None:
        """Stream frames until the driver process closes its end."""
        self._network_end.send(bytes([ipc.PacketKind.READY]))
        self._link.subscribe(TWIST, self._network_end.forward)
        self._link.subscribe(REQUEST, self._network_end.forward)
        self._link.subscribe(ACK, self._on_ack)
        self._link.watch_drivers(self._on_driver_token)
        self._relay = Relay(self._link)
        threading.Thread(target=self._read_driver, name="driver-pipe", daemon=True).start()
        while self.running:
            self._stream_one()

    # --- frames --------------------------------------------------------------------------------------------------

    def _stream_one(self) -> None:
        """Wait for credit, or take an image and publish its frame, after the model of the camera.

        Next: `vision_side/serving/service.py`: `Service.turn`.
        """
        picture = self._read_camera() if self._may_capture() else None
        self._network_core.motion = self._network_end.motion(self._network_core.motion)
        with self._lock:
            sent = self._network_core.on_camera(picture, monotonic_us()) if picture else None
            model = self._camera_model()
            camera = self._network_core.announce_camera(model, monotonic_us()) if model else None
        if camera is not None:
            self._link.publish(camera.channel, camera.header, camera.payload)
        if picture is None:
            return
        if sent is None:
            self._log_rejected()
            return
        header, message = sent
        # The driver process must know a frame before a peer can answer it.
        # 0 means a camera that is not live. The checksum of an empty image is 0, too.
        fingerprint = zlib.crc32(picture.jpeg) or 1 if self.camera and self.camera.live else 0
        if self._network_end.send_aside(ipc.pack_issued(header.seq, header.t_us, fingerprint)):
            self._link.publish(message.channel, message.header, message.payload)

    def _camera_model(self) -> CameraModel | None:
        """Return the model of the camera, or None for an invalid one, which `check_image` reports."""
        try:
            model: object = self.camera.model if self.camera else None
        except BaseException:
            return None
        return model if isinstance(model, CameraModel) else None

    def _log_rejected(self) -> None:
        if (count := self._rejection_limiter.due("image", monotonic_us())):
            often = f" ({count} times)" if count > 1 else ""
            _log.warning("camera: %s%s", self._network_core.image_fault, often)

    def _may_capture(self) -> bool:
        """Return True if the camera may capture now. Otherwise wait briefly, for credit if a frame is due."""
        listening = self._link.has_listener(FRAME)
        with self._lock:
            due = self._network_core.may_capture(monotonic_us(), listening)
            nap_s = self._network_core.wait_us(monotonic_us()) / 1e6
            early_s = self._network_core.early_us(monotonic_us()) / 1e6
        if not due:
            self._no_image_since_us = 0
            longest_s = _LONGEST_NAP_S if monotonic_us() > self._awake_until_us else _SHORT_NAP_S
            if listening and early_s > 0:
                time.sleep(min(early_s, longest_s))  # an answer would only wake this thread too early
            else:
                self._credit.wait(min(nap_s, longest_s) if listening and nap_s > 0 else longest_s)
            self._credit.clear()
        return due

    def _read_camera(self) -> Picture | None:
        """Return an image or None. The loss of the camera is logged once. The camera is then opened again."""
        self._no_image_since_us = self._no_image_since_us or monotonic_us()
        try:
            if self.camera is None:
                self.camera = CAMERAS.build(self._setup.config.camera, is_last=False)
            self._network_core.adapt(self.camera)
            picture = self.camera.read(_CAMERA_TIMEOUT_S)
            if picture is not None:
                check_image(self.camera, picture)
        except BaseException as error:  # signals are ignored, so a KeyboardInterrupt is an error of the camera, too
            self._on_camera_error(error)
            return None
        if picture is not None:
            self._no_image_since_us = 0
            if self._camera_fault:
                _log.info("camera: back")
                self._camera_fault = ""
        return picture

    def _on_camera_error(self, error: BaseException) -> None:
        text = fault_text("camera", error)
        if text in self._setup.camera_fault:  # an earlier process has logged it
            count_fault("camera")
        else:
            report_fault("camera", error)
        if not self._camera_fault:
            _log.warning("camera: %s", text.removeprefix("camera raised "))
        self._camera_fault = text
        time.sleep(_CAMERA_RETRY_S)

    def _check_camera(self, now_us: int) -> None:
        """End this process if a due image did not come in time. The next process opens the camera again."""
        step_us, self._checked_us = min(now_us - self._checked_us, _CHECK_STEP_US), now_us
        if self._no_image_since_us != self._watched_since_us:
            self._watched_since_us, self._waited_us = self._no_image_since_us, 0
        # Limited steps, so that a time in which this process was stopped does not count.
        self._waited_us += step_us * bool(self._watched_since_us)
        if self._waited_us <= self._setup.camera_patience_us:
            return
        kind = self._setup.config.camera.kind
        why = self._camera_fault or f"camera {kind} gives no image"
        self._camera_fault = why if why.endswith(_RESTARTED) else why + _RESTARTED
        _log.error("camera %s: no image for %.1f s; starting it again", kind, self._waited_us / 1e6)
        self._report(now_us)
        logging.shutdown()
        os._exit(CAMERA_EXIT)

    def close_camera(self) -> None:
        """Release the camera if it is open."""
        if self.camera:
            self.camera.close()

    # --- the driver ----------------------------------------------------------------------------------------------

    def _read_driver(self) -> None:
        """Read the pipe until the driver process closes it. Then end the camera loop, or a process that hangs."""
        status_due_us = 0
        try:
            while packet := self._network_end.receive():
                self._network_end.retry()
                with suppress(ValueError):  # a message beyond its limits is lost
                    self._on_packet(packet)
                now_us = monotonic_us()
                self._check_camera(now_us)
                if now_us >= status_due_us:
                    status_due_us = now_us + _STREAM_STATUS_US
                    self._report(now_us)
        finally:
            self.running = False
            self._credit.set()
            time.sleep(_LEAVES_WITHIN_S)
            os._exit(1)

    def _on_packet(self, packet: bytes) -> None:
        kind = ipc.packet_kind(packet)
        if kind is ipc.PacketKind.COMMAND_ACK:
            with self._lock:
                self._network_core.on_command_ack(ipc.unpack_command_ack(packet), monotonic_us())
            self._credit.set()
        elif kind is ipc.PacketKind.PUBLISH:
            message = ipc.unpack_message(packet)
            self._link.publish(message.channel, message.header, message.payload)

    def _report(self, now_us: int) -> None:
        """Send the driver process the state of the stream, and the rejections before the gate."""
        missed = getattr(self.camera, "missed_captures", None)  # of cameras with their own capture thread
        with self._lock:
            status = self._network_core.status(
                now_us, self._network_end.dropped_commands, self._link.dropped, missed() if missed else 0,
                self._camera_fault,
            )
        self._network_end.send(bytes([ipc.PacketKind.STREAM]) + encode(status))
        self._relay.look()
        self._send_tokens()
        self._report_rejected()
        more = faults() - self._faults_reported
        if more and self._network_end.send(ipc.pack_counts(ipc.PacketKind.FAULTS, more)):
            self._faults_reported += more

    def _report_rejected(self) -> None:
        """Send the counts of rejected messages to the driver, so that `status` shows them."""
        by_link: dict[str, int] = dict(self._link.rejected)  # a copy, because other threads change it
        rejected = Counter(dict(self._rejected_acks)) + Counter(by_link)
        if rejected != self._rejected_reported and self._network_end.send(
            ipc.pack_counts(ipc.PacketKind.REJECTED, rejected)
        ):
            self._rejected_reported = rejected

    def _on_driver_token(self, token: str, is_present: bool) -> None:
        now_us = monotonic_us()
        with self._lock:
            self._tokens[token] = is_present
            if is_present and now_us - self._announced_us > _BETWEEN_MODELS_US:
                self._announced_us = now_us
                self._network_core.on_new_driver()
        self._send_tokens()
        self._awake_until_us = now_us + _AWAKE_US
        self._credit.set()

    def _send_tokens(self) -> None:
        """Send waiting tokens to the driver process while there is room. A flood drops the oldest tokens."""
        with self._lock:
            while len(self._tokens) > _MAX_WAITING_TOKENS:
                del self._tokens[next(iter(self._tokens))]
            for token in tuple(self._tokens):
                if not self._network_end.send(ipc.pack_token(token, self._tokens[token])):
                    return
                del self._tokens[token]

    def _on_ack(self, message: Message) -> None:
        try:
            with self._lock:
                self._network_core.on_ack(message, monotonic_us())
        except WireError as error:
            self._rejected_acks[error.reason] += 1
            return
        self._credit.set()


def _open_camera(choice: PluginChoice) -> Camera:
    """Open the camera at the first start. If it hangs, the process ends, because no other part reports it yet."""
    hanging = threading.Timer(_OPENS_WITHIN_S, _end_hanging, [choice.kind])
    hanging.daemon = True
    hanging.start()
    try:
        return CAMERAS.build(choice)
    finally:
        hanging.cancel()


def _end_hanging(kind: str) -> None:
    why = f"camera {kind} does not open within {_OPENS_WITHIN_S:g} s; unplug it and plug it in again"
    print(error_line(why), file=sys.stderr, flush=True)
    os._exit(HardwareError.exit_code)


def _run(setup: NetworkSetup, driver: NetworkEnd) -> None:
    config = setup.config
    with ExitStack() as ending:
        # After a restart the link is opened first, so that a robot without a camera can be reached.
        camera = None if setup.is_restart else _open_camera(config.camera)
        ending.enter_context(limit_floods(config.doors, lambda line: _log.info("robot %s: %s", config.robot, line)))
        if problem := date_problem(config.secure, ROBOT_ROLE):
            _log.warning("robot %s: %s", config.robot, problem)
        link = ending.enter_context(
            open_link(
                config.robot, listen=config.doors, connect=config.connect, role="robot", secure=config.secure,
                session=setup.session,
            )
        )
        where = ", ".join(config.listen) or "no port of its own"
        where += f", connects to {', '.join(config.connect)}" if config.connect else ""
        _log.info("robot %s: on %s, camera %s", config.robot, where, config.camera.kind)
        if reached := reachable_endpoints(config.listen):
            _log.info("robot %s: others reach it at %s", config.robot, ", ".join(reached))
        process = NetworkProcess(setup, driver, link, camera)
        ending.callback(process.close_camera)
        process.run()


def _ignore_exit_signals() -> None:
    """Ignore the signals of terminals and systemd to all processes. The driver ends this process after zero."""
    for number in EXIT_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # A handler, because a child of a camera plug-in, e.g. rpicam-vid, would inherit SIG_IGN and ignore SIGTERM.
    signal.signal(signal.SIGTERM, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, EXIT_SIGNALS)


def main() -> None:
    """Run the network process. argv[1] and argv[2] are the descriptors of its sockets."""
    start_log(None, "robot")
    _ignore_exit_signals()
    driver = NetworkEnd(*(socket.socket(fileno=int(number)) for number in sys.argv[1:3]))
    setup = NetworkSetup.model_validate_json(driver.receive())
    code = 1
    try:
        _run(setup, driver)
        code = 0
    except SightlineError as error:
        code = error.exit_code
        if setup.is_restart:
            _log.error("robot %s: %s", setup.config.robot, error)
        else:  # the normal end of the program
            logging.shutdown()
            print(error_line(str(error)), file=sys.stderr)
    except BaseException as error:  # also of a plug-in: signals are ignored
        report_fault("network process", error)
        driver.send(ipc.pack_counts(ipc.PacketKind.FAULTS, {"network process": 1}))
    finally:
        logging.shutdown()
        os._exit(code)  # daemon threads of a transport must not block the end


if __name__ == "__main__":
    main()
