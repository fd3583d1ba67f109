"""The simulation in real time, as a process that stands in for the hardware. Shell.

The main thread steps and draws against absolute deadlines; another receives (`sockets.py`), so that a motor command is
stamped and logged while a picture is being drawn. World time and the robot's monotonic clock differ by a constant.
"""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from types import FrameType
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError
from sightline.sim.bus import (
    CAMERA,
    MOTION,
    MOTION_ANGLES,
    PICTURE_HEAD,
    RANGE,
    RANGE_HEAD,
    TRUTH,
    SimSocketConfig,
    SimulationInfo,
)
from sightline.sim.process import PeriodicTimer
from sightline.sim.label_bus import to_json
from sightline.sim.motor_port import MotorPort
from sightline.sim.robot import load_robot
from sightline.sim.scenario import load_scenario
from sightline.sim.sockets import BusClients, SocketFolder

if TYPE_CHECKING:
    from sightline.sim.world.world import World

ENCODERS_US, TRUTH_US = 10_000, 20_000
LAG_TOLD_US = 100_000
LAG_GIVEN_UP_US = 1_000_000  # after a suspended machine, time is skipped rather than replayed


class SimConfig(SimSocketConfig):
    """One simulated robot."""

    scenario: Annotated[str, Field(min_length=1)] = "circle"
    """A name (`sim/scenarios/`) or the path of a `.toml` file."""
    robot: str = ""
    """A name (`sim/robots/`) or the path of a `.toml` file; empty for the one that the scenario names."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    motor_log: str | None = None
    """CSV of every motor command, stamped on receipt."""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """End by itself after this long."""


class Simulation:
    """A world, its clients and the clock that drives it."""

    def __init__(self, config: SimConfig, world: World, folder: SocketFolder) -> None:
        self._config, self._world = config, world
        self._motors = MotorPort(config.motor_log)
        self._clients = BusClients(folder, self._hellos(), self._motors.take)
        self._encoders, self._truth = PeriodicTimer(ENCODERS_US), PeriodicTimer(TRUTH_US)
        self._frames = PeriodicTimer(1e6 / world.robot.camera.fps)
        self._scans = PeriodicTimer(1e6 / world.robot.lidar.rate_hz)
        self._offset_us = monotonic_us()
        self._lag_us = 0
        self._told_lag = False
        self.stopping = False

    def _hellos(self) -> dict[str, bytes]:
        config = self._config
        robot = config.robot or self._world.scenario.robot
        about = SimulationInfo(scenario=config.scenario, robot=robot, seed=config.seed, pid=os.getpid())
        return {CAMERA: encode(self._world.camera_model), TRUTH: about.model_dump_json().encode()}

    def run(self) -> None:
        """Step until told to stop or the time is over."""
        end_us = self._config.seconds * 1e6 if self._config.seconds else float("inf")
        self._offset_us = monotonic_us()
        while not self.stopping and self._world.now_us < end_us:
            self._wait()
            self._world.set_wheels(*self._motors.speeds_rad_s)
            self._world.step()
            self._motors.angles_rad = self._world.wheels_turned()
            self._publish(self._world.now_us)

    def _wait(self) -> None:
        """Sleep to the next step's deadline, and mind how late it is."""
        from sightline.sim.world.world import STEP_US

        late_us = monotonic_us() - (self._offset_us + self._world.now_us + STEP_US)
        if late_us < 0:
            time.sleep(-late_us / 1e6)
        self._lag_us = max(0, late_us)
        if self._lag_us > LAG_TOLD_US and not self._told_lag:
            print(f"simulation is {self._lag_us // 1000} ms behind the clock; is the machine busy?", flush=True)
        self._told_lag = self._lag_us > (LAG_TOLD_US // 5 if self._told_lag else LAG_TOLD_US)
        if self._lag_us > LAG_GIVEN_UP_US:
            self._offset_us += self._lag_us

    def _publish(self, now_us: int) -> None:
        """Send what is due and wanted."""
        t_us = now_us + self._offset_us
        if self._encoders.due(now_us):
            angles = self._world.wheel_angles()
            self._clients.send(MOTION, MOTION_ANGLES.pack(angles.left_rad, angles.right_rad, t_us))
        if self._frames.due(now_us):
            self._draw(t_us)
        if self._scans.due(now_us) and self._clients.has(RANGE):
            self._clients.send(RANGE, self._scan(t_us))
        if self._truth.due(now_us) and self._clients.has(TRUTH):
            truth = replace(self._world.truth(), t_us=t_us, lag_us=self._lag_us)
            self._clients.send(TRUTH, truth.to_json())

    def _draw(self, t_us: int) -> None:
        """A picture for each way in which one is wanted: one, unless cameras differ in what they ask."""
        asked = self._clients.wanted_pictures()
        if asked and self._world.scenario.labels and self._clients.has(TRUTH):
            self._clients.send(TRUTH, to_json(self._world.labels(), t_us, self._world.camera_model.width_px))
        for wanted in asked:
            self._clients.send_picture(wanted, PICTURE_HEAD.pack(t_us, wanted[1]) + self._world.render(*wanted))

    def _scan(self, t_us: int) -> bytes:
        scan = self._world.scan()
        limits = (scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, scan.range_max_m)
        return RANGE_HEAD.pack(t_us, *limits) + scan.ranges_m.tobytes()

    def close(self) -> None:
        """End every connection and the log."""
        self._clients.close()
        self._motors.close()


def run(config: SimConfig) -> int:
    """Simulate until SIGTERM, SIGINT or `seconds`; call it from the main thread.

    Prints one line that begins with `simulation ready` once everything accepts. Raises ConfigError for an unknown
    scenario or robot, a `socket_dir` in use, a missing extra.
    """
    scenario = load_scenario(config.scenario)
    robot = load_robot(config.robot or scenario.robot)
    folder = SocketFolder(config.socket_dir)
    try:
        with _world_class()(scenario, robot, config.seed) as world:
            _simulate(Simulation(config, world, folder), config, robot.name)
    finally:
        folder.close()
    return 0


def _simulate(simulation: Simulation, config: SimConfig, robot: str) -> None:
    def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  the signature is Python's
        simulation.stopping = True

    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        print(f"simulation ready: {config.scenario}, {robot}, seed {config.seed}, in {config.socket_dir}",
              flush=True)
        simulation.run()
    finally:
        simulation.close()
        for number, handler in before.items():
            signal.signal(number, handler)


def _world_class() -> type[World]:
    """Imported late: whoever only reads `SimConfig` needs neither PyBullet nor NumPy."""
    try:
        from sightline.sim.world.world import World
    except ImportError as error:
        raise ConfigError(f"the simulation needs {error.name}; install it with: pip install 'sightline[sim]'") from None
    return World
