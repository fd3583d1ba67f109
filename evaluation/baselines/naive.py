"""A robot without safety rules, for comparison only: it repeats its last command forever. Shell (a process).

    python -m sightline.evaluation.baselines.naive OPTIONS_AS_JSON

It sends the frames of the simulated camera and drives the simulated wheels, as `sightline robot` does, and the same
vision service steers it. It has no gate: no frame age, no silence limit, no lease, no ramp, no STOP. Many small robot
programs are written like this: the callback stores a command, the loop sends it to the motors.
"""

import secrets
import signal
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any, Final

from sightline.protocol.channels import CAMERA, FRAME, STATUS, TWIST
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.config import Config
from sightline.protocol.errors import LinkError, SightlineError, WireError
from sightline.protocol.messages import STILL, AnswerHeader, FrameHeader, Stamp, State, Status, Twist
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import open_link
from sightline.robot_side.kinematics import DiffDriveConfig, Odometer, wheel_speeds
from sightline.sim.bus import SimCamera, SimDrive, SimSocketConfig

READY: Final = "naive robot is on"
PERIOD_S: Final = 0.02
_CAMERA_EVERY_US: Final = 500_000
_STATUS_EVERY_US: Final = 100_000
_FRAME_WAIT_S: Final = 0.1


class NaiveOptions(Config):
    """The simulation of the robot and the endpoint for the vision service."""

    robot: str = "r1"
    listen: str
    socket_dir: str


@dataclass(slots=True)
class LastCommand:
    """The newest command, and the age of its frame on arrival. Nothing removes it."""

    twist: Twist = STILL
    latency_us: int | None = None

    def take(self, message: Message) -> None:
        """Store the command of `message` unless it is invalid."""
        try:
            twist, header = parse_twist(message.payload), decode(AnswerHeader, message.header)
        except WireError:
            return
        echo = header.echo
        self.twist, self.latency_us = twist, monotonic_us() - echo.t_us if echo is not None else None


class NaiveRobot:
    """Passes images from the camera to the link, and commands from the link to the wheels."""

    def __init__(self, link: Link, camera: SimCamera, drive: SimDrive) -> None:
        self._link, self._camera, self._drive = link, camera, drive
        self._wheels, self._command = DiffDriveConfig(), LastCommand()
        self._odometer = Odometer(self._wheels)
        self._session, self._seq = secrets.token_hex(4), 0
        self._due_us = {CAMERA.name: 0, STATUS.name: 0}
        link.subscribe(TWIST, self._command.take)

    def stream(self, ending: threading.Event) -> None:
        """Send each frame until `ending`, on a separate thread."""
        while not ending.is_set():
            picture = self._camera.read(_FRAME_WAIT_S)
            self._announce()
            if picture is None:
                continue
            twist = self._command.twist
            header = FrameHeader(
                **self._stamp(picture.t_us), pose=self._odometer.pose, moving=self._odometer.moving,
                applied=(twist.linear_mps, twist.angular_rad_s), latency_us=self._command.latency_us,
            )
            self._link.publish(FRAME, encode(header), picture.jpeg)

    def drive(self, ending: threading.Event) -> None:
        """Apply the last command to the wheels at 50 Hz until `ending`, then zero."""
        while not ending.wait(PERIOD_S):
            turned = self._drive.wheels()
            if turned is not None:
                self._odometer.update(turned)
            self._drive.set(*wheel_speeds(self._wheels, self._command.twist))
        self._drive.set(0.0, 0.0)

    def _announce(self) -> None:
        """Publish the camera model and a status at their rates."""
        now_us = monotonic_us()
        if now_us >= self._due_us[CAMERA.name]:
            self._due_us[CAMERA.name] = now_us + _CAMERA_EVERY_US
            self._link.publish(CAMERA, encode(Stamp(**self._stamp(now_us))), encode(self._camera.model))
        if now_us >= self._due_us[STATUS.name]:
            self._due_us[STATUS.name] = now_us + _STATUS_EVERY_US
            status = Status(state=State.ACTIVE, reason="repeats its last command")
            self._link.publish(STATUS, encode(Stamp(**self._stamp(now_us))), encode(status))

    def _stamp(self, t_us: int) -> dict[str, Any]:
        self._seq += 1
        return {"session": self._session, "seq": self._seq, "t_us": t_us}


def main() -> int:
    """Run until SIGTERM; returns the exit code."""
    options, ending = NaiveOptions.model_validate_json(sys.argv[1]), threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ending.set())
    sockets = SimSocketConfig(socket_dir=options.socket_dir)
    try:
        with open_link(options.robot, listen=[options.listen], role="robot") as link:
            robot = NaiveRobot(link, SimCamera(sockets), SimDrive(sockets))
            streaming = threading.Thread(target=robot.stream, args=(ending,), name="camera", daemon=True)
            streaming.start()
            print(READY, flush=True)
            robot.drive(ending)
            streaming.join(2 * _FRAME_WAIT_S)
    except (LinkError, SightlineError) as error:
        print(f"error: {error}", flush=True)
        return 1
    time.sleep(PERIOD_S)  # the simulation reads zero before the socket closes
    return 0


if __name__ == "__main__":
    sys.exit(main())
