"""The robot's own pure logic as a peer in virtual time, with seams where a broken robot can be made of it. Pure."""

import array
import math

from sightline.conformance.benches import FROM_ROBOT, VirtualBench
from sightline.conformance.case import Access
from sightline.protocol.channels import ACK, FRAME, REQUEST, TWIST, key_for
from sightline.protocol.errors import WireError
from sightline.protocol.messages import CameraModel
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.ports import Picture, Ranges, WheelAngles
from sightline.robot_side.safety.limits import TICK_US, SafetyConfig
from tests.fixtures.robot_process import JPEG

MODEL = CameraModel(width_px=16, height_px=16, fx_px=20.0, fy_px=20.0, cx_px=8.0, cy_px=8.0)
CAMERA_US = 1e6 / 30
SCAN_US = 100_000
STREAM_US = 200_000
KEYS = Access({"vision": "0123456789abcdefABCDEF_-", "operator": "0123456789abcdefABCDEF_+"})
KEYED = ("R-PROOF-16",)
"""Cases about a robot with keys. A network in memory checks no token."""


class ReferenceRobot:
    """`driving` and `sending` are what the real processes run; every message passes `receive` or `emit`."""

    def __init__(self, network: MemoryNetwork, *, session: str = "00000001", **safety):
        self.network = network
        self.now_us = network.now_us
        self.config = RobotConfig(safety=SafetyConfig(**{"guests": True, **safety}))
        self.driving = DriverCore(self.config, session)
        self.sending = NetworkCore(self.config.stream, session, 0, self.config.max_frame_bytes)
        self.link = network.link("r1")
        self.hook()
        self._ticked_us = self._scanned_us = self._reported_us = -1_000_000
        self._filmed = math.ceil(self.now_us / CAMERA_US)
        self._angles = [0.0, 0.0]
        self._speeds = (0.0, 0.0)

    def hook(self):
        """Subscribe."""
        for channel in (TWIST, REQUEST, ACK):
            self.link.subscribe(channel, self.receive)
        self.link.watch_drivers(lambda token, is_present: self.driving.on_token(token, is_present, self.now()))

    # --- seams ---------------------------------------------------------------------------------------------------

    def receive(self, message):
        """Pass an incoming message to the handler of its channel."""
        {"twist": self.on_twist, "request": self.on_request, "ack": self.on_ack}[message.channel.name](message)

    def on_twist(self, message):
        """A command."""
        ack = self.driving.on_twist(message, self.now())
        if ack is not None:
            self.sending.on_command_ack(ack, self.now())

    def on_request(self, message):
        """Handle an operator's request; its reply leaves immediately."""
        self.driving.on_request(message, self.now())

    def on_ack(self, message):
        """An acknowledgement."""
        try:
            self.sending.on_ack(message, self.now())
        except WireError as error:
            self.driving.rejected_by_transport[error.reason] += 1

    def emit(self, message):
        """Send an outgoing message."""
        self.send(message.channel, message.header, message.payload)

    def send(self, channel, header, payload, key=None):
        """Send bytes to every listener, past the bounds of a well-behaved link."""
        self.network.put(key or key_for("r1", channel), header, payload, self.link)

    def listening(self):
        """Return whether any peer wants frames."""
        return self.link.has_listener(FRAME)

    def film(self, now_us):
        """The camera's tick: a frame, if the stream wants one."""
        if self.sending.may_capture(now_us, self.listening()):
            self.capture(Picture(JPEG, now_us))

    def capture(self, picture):
        """A picture becomes a frame."""
        sent = self.sending.on_camera(picture, self.now())
        if sent is not None:
            header, message = sent
            self.issue(header)
            self.emit(message)

    def issue(self, header):
        """Announce a frame to the driver before any peer can answer it."""
        self.driving.on_issued(header.seq, header.t_us, 0)

    # --- time ----------------------------------------------------------------------------------------------------

    def now(self):
        """The robot's clock."""
        return self.network.now_us

    def tick(self, now_us):
        """Everything that is due."""
        if now_us - self._ticked_us >= TICK_US:
            self._drive(now_us)
            for message in self.driving.messages(now_us):
                self.emit(message)
        if now_us - self._reported_us >= STREAM_US:
            self._reported_us = now_us
            self.driving.stream = self.sending.status(now_us)
        camera = self.sending.announce_camera(MODEL, now_us)
        if camera is not None:
            self.emit(camera)
        if now_us >= self._filmed * CAMERA_US:
            self._filmed += 1
            self.film(now_us)

    def _drive(self, now_us):
        elapsed_s = (now_us - self._ticked_us) / 1e6 if self._ticked_us > 0 else 0.0
        self._ticked_us = now_us
        self._angles = [angle + speed * elapsed_s for angle, speed in zip(self._angles, self._speeds, strict=True)]
        scan = None
        if now_us - self._scanned_us >= SCAN_US:
            self._scanned_us = now_us
            scan = Ranges(now_us, -3.0, 1.0, 0.1, 8.0, array.array("f", [math.inf] * 7))
        self._speeds = self.driving.tick(now_us, WheelAngles(*self._angles, now_us), scan)
        self.sending.motion = self.driving.motion()


def virtual_robot(break_it=None, *, keys=False, **safety):
    """(bench, robot): a fresh robot, broken by `break_it(robot)` if that is given, and the kit connected to it."""
    network = MemoryNetwork()
    network.advance(1_000_000)
    robot = ReferenceRobot(network, **safety)
    robot.driving.gate._needs_proof = keys
    if break_it is not None:
        break_it(robot)
    return VirtualBench(network, [robot], FROM_ROBOT, access=KEYS if keys else None), robot
