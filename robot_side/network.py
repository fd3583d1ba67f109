"""The network process: camera and link; forwards raw commands to the driver, publishes for it. Shell.

Started by `robot_side.child` with one end of a socket pair; it ends when that socket closes.
"""

import os
import signal
import socket
import sys
import threading
import time
import zlib
from contextlib import ExitStack, suppress

from protocol.channels import ACK, FRAME, REQUEST, TWIST
from protocol.codec import encode
from protocol.errors import HardwareError, SightlineError, WireError
from protocol.transports.link import Link, Message
from protocol.transports.opening import open_link
from robot_side import ipc
from robot_side.child import Setup
from robot_side.plugins import build
from robot_side.ports import Camera, Picture
from robot_side.sending import Sending

_STREAM_STATUS_US = 200_000
_CAMERA_TIMEOUT_S = 0.2
_CAMERA_RETRY_S = 0.5
_LONGEST_NAP_S = 0.1
_LEAVES_WITHIN_S = 3.0


class Network:
    """The camera loop (main thread), the driver's packets (a thread), the link's callbacks (its thread)."""

    def __init__(self, setup: Setup, driver: socket.socket, link: Link, camera: Camera) -> None:
        self._driver = driver
        self._link = link
        self._camera = camera
        config = setup.config
        self._sending = Sending(config.stream, setup.session, setup.first_seq, config.max_frame_bytes)
        self._lock = threading.Lock()
        self._credit = threading.Event()
        self._dropped_commands = 0
        self._camera_fault = ""
        self.running = True

    def run(self) -> None:
        """Until the driver closes its end."""
        self._to_driver(bytes([ipc.Kind.READY]))
        self._link.subscribe(TWIST, self._forward)
        self._link.subscribe(REQUEST, self._forward)
        self._link.subscribe(ACK, self._on_ack)
        threading.Thread(target=self._read_driver, daemon=True).start()
        while self.running:
            self._stream_one()

    # --- frames --------------------------------------------------------------------------------------------------

    def _stream_one(self) -> None:
        listening = self._link.has_listener(FRAME)
        with self._lock:
            due = self._sending.may_capture(_now_us(), listening)
            nap_s = self._sending.wait_us(_now_us()) / 1e6
        if not due:
            self._credit.wait(min(nap_s, _LONGEST_NAP_S) if listening and nap_s > 0 else _LONGEST_NAP_S)
            self._credit.clear()
            return
        picture = self._read_camera()
        if picture is not None:
            self._send(picture)

    def _read_camera(self) -> Picture | None:
        """A picture, or None; a camera that is gone is said once and tried again."""
        try:
            picture = self._camera.read(_CAMERA_TIMEOUT_S)
        except HardwareError as error:
            if not self._camera_fault:
                print(f"camera: {error}", file=sys.stderr, flush=True)
            self._camera_fault = str(error)
            time.sleep(_CAMERA_RETRY_S)
            return None
        if self._camera_fault and picture is not None:
            print("camera: back", flush=True)
            self._camera_fault = ""
        return picture

    def _send(self, picture: Picture) -> None:
        with self._lock:
            sent = self._sending.on_camera(picture, _now_us())
        if sent is None:
            return
        header, message = sent
        # The driver must know a frame before anybody can answer it.
        fingerprint = zlib.crc32(picture.jpeg) if self._camera.live else 0
        if self._to_driver(ipc.pack_issued(header.seq, header.t_us, fingerprint)):
            self._link.publish(message.channel, message.header, message.payload)

    # --- the driver ----------------------------------------------------------------------------------------------

    def _to_driver(self, packet: bytes) -> bool:
        try:
            self._driver.send(packet, socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def _forward(self, message: Message) -> None:
        """A command goes on at once, undecoded; when the driver does not keep up, it is dropped and counted."""
        if not self._to_driver(ipc.pack_message(ipc.Kind.RAW, message)):
            self._dropped_commands += 1

    def _read_driver(self) -> None:
        """Until the driver closes its end; then the camera loop ends, or the whole process if it hangs."""
        status_due_us = 0
        try:
            while packet := self._receive():
                with suppress(ValueError):  # a message over its bounds: one lost message
                    self._on_packet(packet)
                now_us = _now_us()
                if now_us >= status_due_us:
                    status_due_us = now_us + _STREAM_STATUS_US
                    self._report(now_us)
        finally:
            self.running = False
            self._credit.set()
            time.sleep(_LEAVES_WITHIN_S)
            os._exit(1)

    def _receive(self) -> bytes:
        try:
            return self._driver.recv(ipc.MAX_PACKET_BYTES)
        except OSError:
            return b""

    def _on_packet(self, packet: bytes) -> None:
        kind = ipc.kind_of(packet)
        if kind is ipc.Kind.MOTION:
            self._sending.motion = ipc.unpack_motion(packet)
        elif kind is ipc.Kind.VERDICT:
            with self._lock:
                self._sending.on_judged(ipc.unpack_judged(packet), _now_us())
            self._credit.set()
        elif kind is ipc.Kind.PUBLISH:
            message = ipc.unpack_message(packet)
            self._link.publish(message.channel, message.header, message.payload)

    def _report(self, now_us: int) -> None:
        """Tell the driver how the stream does, and everybody what the camera is."""
        with self._lock:
            status = self._sending.status(now_us, self._dropped_commands, self._camera.model.calibrated)
            camera = self._sending.camera_message(self._camera.model, now_us)
        self._to_driver(bytes([ipc.Kind.STREAM]) + encode(status))
        if camera is not None:
            self._link.publish(camera.channel, camera.header, camera.payload)

    def _on_ack(self, message: Message) -> None:
        try:
            with self._lock:
                self._sending.on_ack(message, _now_us())
        except WireError:
            return
        self._credit.set()


def _now_us() -> int:
    return time.monotonic_ns() // 1000


def _run(driver: socket.socket) -> None:
    setup = Setup.model_validate_json(driver.recv(ipc.MAX_PACKET_BYTES))
    config = setup.config
    with ExitStack() as ending:
        camera: Camera = build("cameras", config.camera)
        ending.callback(camera.close)
        link = ending.enter_context(
            open_link(config.robot, listen=config.listen, connect=config.connect, role="robot")
        )
        where = ", ".join(config.listen) or "connected to " + ", ".join(config.connect)
        print(f"robot {config.robot}: on {where}, camera {config.camera.kind}", flush=True)
        Network(setup, driver, link, camera).run()


def main() -> None:
    """Entry of the child process: argv[1] is the socket's descriptor."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the driver ends us, after zero
    driver = socket.socket(fileno=int(sys.argv[1]))
    code = 1
    try:
        _run(driver)
        code = 0
    except SightlineError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        code = error.exit_code
    except Exception as error:
        print(f"error: network process: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(code)  # daemon threads of a transport must not keep a finished process


if __name__ == "__main__":
    main()
