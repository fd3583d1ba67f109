"""Sightline itself as a contestant of `bench loop`: the real robot and vision services. Shell (processes)."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sightline.benchmarks.loop.figures import (
    MAX_ANGULAR_RAD_S,
    Accepted,
    Course,
    LoopSetting,
    changes_us,
    course_of_headers,
    read_wheel_commands,
    repeats_us,
)
from sightline.evaluation.processes import Processes, free_port
from sightline.protocol.channels import STATUS
from sightline.protocol.codec import decode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import Stamp, Status
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.open import open_link

ROBOT: Final = "r1"
_WHEELS: Final = "wheels.csv"
TRANSPORTS: Final = {"zenoh": "tcp/127.0.0.1:{}", "websocket": "ws://127.0.0.1:{}"}


@dataclass(slots=True)
class Ours:
    """The running services."""

    pids: dict[str, int]
    ports: tuple[int, ...]
    endpoint: str
    tally: Path
    wheels: Path
    """The motor log."""
    accepted: list[Accepted] = field(default_factory=list)

    def note(self, message: Message) -> None:
        """Store the count of accepted commands in a status."""
        stamp, status = decode(Stamp, message.header), decode(Status, message.payload, STATUS.max_payload_bytes)
        self.accepted.append((stamp.t_us, status.accepted))

    def course(self, begin_us: int, end_us: int) -> Course:
        """Return the course of that time. Call it only after the end of the vision service."""
        noted = json.loads(self.tally.read_text())
        headers = [(seq, t_us, latency_us) for seq, t_us, latency_us in noted["headers"]]
        sets_us = changes_us(read_wheel_commands(self.wheels.read_text("ascii")))
        return course_of_headers(headers, self.accepted, sets_us, begin_us, end_us, copies=noted["copies"],
                                 repeated_us=repeats_us(noted["commands"]))


def endpoint_of(transport: str, port: int) -> str:
    """Return an endpoint of `transport`. Raises ConfigError for an unknown transport."""
    if transport not in TRANSPORTS:
        raise ConfigError(f"--transport {transport!r}: {', '.join(TRANSPORTS)}")
    return TRANSPORTS[transport].format(port)


@contextmanager
def running_services(setting: LoopSetting, folder: Path, processes: Processes) -> Iterator[Ours]:
    """Run robot and vision service until both work. Raises HardwareError with the error of a failed start."""
    port = free_port()
    endpoint = endpoint_of(setting.transport, port)
    guardian = processes.start("robot", ["robot", "--config", str(_robot_toml(setting, folder, endpoint))])
    processes.wait_line("robot", f"robot {ROBOT}: on")
    with open_link(ROBOT, connect=[endpoint], role="operator") as link:
        tally = folder / "headers.json"
        settings = {"robot": ROBOT, "connect": [endpoint], "tally": str(tally),
                    "delay_ms": setting.detector_delay_ms, "busy_ms": setting.busy_ms}
        vision = processes.start("vision", [json.dumps(settings)], module="sightline.benchmarks.loop.vision")
        pids = {"guardian": guardian, "driver": processes.driver("robot"), "network": processes.network("robot"),
                "stop": processes.stop("robot"), "vision": vision}
        ours = Ours(pids, (port,), endpoint, tally, folder / _WHEELS)
        link.subscribe(STATUS, ours.note)
        processes.wait_line("vision", "target seen")
        yield ours


def _robot_toml(setting: LoopSetting, folder: Path, endpoint: str) -> Path:
    """Write robot.toml; strings and numbers of JSON are valid TOML.

    The ramp is as fast as permitted. It ends before the next command, so that only a new command changes the speeds.
    """
    path = folder / "robot.toml"
    path.write_text(
        f"robot = {json.dumps(ROBOT)}\nlisten = [{json.dumps(endpoint)}]\nstate_dir = {json.dumps(str(folder))}\n"
        f'[camera]\nkind = "folder"\noptions = {{path = {json.dumps(str(setting.pictures))}, fps = {setting.fps}}}\n'
        f'[drive]\nkind = "log"\noptions = {{path = {json.dumps(str(folder / _WHEELS))}}}\n'
        f'[safety]\nauto_arm = true\nmax_angular_rad_s = {MAX_ANGULAR_RAD_S}\nmax_acceleration_mps2 = 20.0\n'
        "max_acceleration_rad_s2 = 100.0\nmax_jerk_mps3 = 500.0\nmax_jerk_rad_s3 = 2000.0\n"
        f"[stream]\nmax_fps = {setting.fps}\n",
        "utf-8",
    )
    return path
