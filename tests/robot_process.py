"""A real robot service in its own processes, with a log drive and a folder of pictures; and a vision to drive it."""

import itertools
import json
import os
import secrets
import signal
import subprocess
import sys
import threading
from pathlib import Path

from sightline.protocol.channels import FRAME, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader, Status
from sightline.protocol.transports.zenoh.link import open_zenoh
from tests.link_rigs import free_endpoint, until

# A 16 x 16 grey JPEG is enough: the robot never decodes.
JPEG = bytes.fromhex(
    "ffd8ffe000104a46494600010100000100010000ffdb004300080606070605080707070909080a0c140d0c0b0b0c1912130f141d1a1f1e1d"
    "1a1c1c20242e2720222c231c1c2837292c30313434341f27393d38323c2e333432ffc0000b080010001001011100ffc4001f0000010501"
    "010101010100000000000000000102030405060708090a0bffc400b5100002010303020403050504040000017d01020300041105122131"
    "410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a25262728292a3435363738393a434445464748494a"
    "535455565758595a636465666768696a737475767778797a838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6"
    "b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9faffda0008010100003f00fbd0"
    "ffd9"
)
_RUN = """
import sys
from sightline.protocol.errors import SightlineError
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.driver.process import run
try:
    sys.exit(run(RobotConfig.model_validate_json(sys.argv[1])))
except SightlineError as error:
    print(f"error: {error}", file=sys.stderr)
    sys.exit(error.exit_code)
"""


class RobotProcess:
    """`with RobotProcess(tmp_path) as robot`: ended, and checked for leftovers, at the end."""

    def __init__(self, folder: Path, **changes):
        pictures = folder / "pictures"
        pictures.mkdir(exist_ok=True)
        (pictures / "0.jpg").write_bytes(JPEG)
        self.endpoint = changes.pop("endpoint", None) or free_endpoint()
        self.drive_log = folder / "drive.csv"
        self.config = {
            "listen": [self.endpoint],
            "camera": {"kind": "folder", "options": {"path": str(pictures)}},
            "drive": {"kind": "log", "options": {"path": str(self.drive_log)}},
            "state_dir": str(folder / "state"),
            "safety": {"auto_arm": True},
            **changes,
        }
        self._out = (folder / "robot.log").open("a+")

    def __enter__(self):
        command = [sys.executable, "-c", _RUN, json.dumps(self.config)]
        self.process = subprocess.Popen(command, stdout=self._out, stderr=subprocess.STDOUT)
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
            self.process.wait(5)
        self._out.close()

    def output(self) -> str:
        """All it has printed."""
        self._out.flush()
        return Path(self._out.name).read_text()

    def network_pid(self) -> int:
        """The pid of the network process, the driver's only child."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        assert len(children) == 1, children
        return int(children[0])

    def kill_network(self, number=signal.SIGKILL) -> None:
        """Send it a signal."""
        os.kill(self.network_pid(), number)

    def motor_rows(self):
        """(t_us, left_rad_s, right_rad_s) of the motors' own log."""
        text = self.drive_log.read_text()
        whole = text[: text.rfind("\n") + 1].splitlines()  # the last line may still be being written
        rows = [line.split(",") for line in whole]
        return [(int(t), float(left), float(right)) for t, left, right in rows]

    def speed(self) -> float:
        """The last speed given to a wheel, rad/s, the larger of the two."""
        rows = self.motor_rows()
        return max(abs(rows[-1][1]), abs(rows[-1][2])) if rows else 0.0


class Vision:
    """Answers every frame with the same twist, on a thread, until it is closed."""

    def __init__(self, endpoint: str, twist: bytes = b"0.4000|0.0000", echo_channel: str = "frame", secure: str = ""):
        self.twist = twist
        self.session = secrets.token_hex(4)
        self.headers = []
        self.link = open_zenoh("r1", connect=[endpoint], role="vision", timeout_s=10, secure=secure)
        self.status_slot = self.link.latest(STATUS)
        self._frames = self.link.latest(FRAME)
        self._running = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        seq = 0
        while self._running:
            message = self._frames.take(0.1)
            if message is None:
                continue
            header = decode(FrameHeader, message.header)
            self.headers.append(header)
            echo = Echo(channel="frame", session=header.session, seq=header.seq, t_us=header.t_us)
            answer = AnswerHeader(source="vision", session=self.session, seq=seq, echo=echo)
            self.link.publish(TWIST, encode(answer), self.twist)
            seq += 1

    def status(self) -> Status:
        """The next status."""
        self.status_slot.take()
        return decode(Status, self.status_slot.take(2.0).payload, 4096)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._running = False
        self._thread.join()
        self.link.close()


def driving(robot: RobotProcess, speed_rad_s: float = 10.0) -> bool:
    """Wait until the wheels turn that fast."""
    return until(lambda: robot.speed() >= speed_rad_s, 8.0)


def stop_after(rows, since_us: int, wheel_radius_m: float = 0.035):
    """(seconds, metres) from `since_us` until the motors' log first shows zero; fails if it never does."""
    zero_us = next(t for t, left, right in rows if t >= since_us and left == right == 0.0)
    metres = 0.0
    for (t, left, right), (after, _, _) in itertools.pairwise(rows):
        if after > since_us and t < zero_us:
            metres += abs(left + right) / 2 * wheel_radius_m * (after - max(t, since_us)) / 1e6
    return (zero_us - since_us) / 1e6, metres
