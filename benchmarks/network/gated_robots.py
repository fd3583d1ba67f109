"""Many robots in one process, each with its real gate, for the rows with several vision services. Shell.

    python -m sightline.benchmarks.network.gated_robots SETTINGS_AS_JSON

A robot here has its own session, credit, status, driver core and gate, and no motors: the gate decides. Written at
SIGTERM as JSON, for each robot: `accepted`, the accepted commands as (arrival_us, digest of the sender, capture_us of
its frame), `holds`, the times (begin_us, end_us) without motion after the first command, `began_us`, the time of its
first image, `sent_us`, the capture times of its frames, and the number of `answers`, accepted or not.
"""

import sys
from typing import Any

from sightline.benchmarks.network.robots import PlayedRobot, Settings, main
from sightline.protocol.channels import ACK
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.messages import AnswerHeader, State
from sightline.protocol.transports.link import Link, Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.safety.limits import TICK_US, SafetyConfig


class GatedRobot(PlayedRobot):
    """A simulated robot whose commands pass the driver core."""

    def __init__(self, name: str, link: Link, settings: Settings, due_us: int) -> None:
        super().__init__(name, link, settings, due_us)
        log = PluginChoice(kind="log")  # without a range sensor
        config = RobotConfig(robot=name, camera=log, drive=log, safety=SafetyConfig(auto_arm=True))
        self.core = DriverCore(config, self._session)
        self.accepted: list[tuple[int, str, int]] = []
        self._sent_us: list[int] = []
        self._answers = 0
        self.holds: list[list[int]] = []
        self._tick_due_us = self._began_us = due_us
        link.watch_drivers(self._on_token)

    @property
    def record(self) -> dict[str, Any]:
        """Return the record of this robot."""
        return {"accepted": self.accepted, "holds": self.holds, "answers": self._answers,
                "began_us": self._began_us, "sent_us": self._sent_us}

    def play(self, at_us: int) -> int:
        """Do the due work, including that of the gate."""
        if at_us >= self._tick_due_us:
            self._tick_due_us = max(self._tick_due_us + TICK_US, at_us)
            with self._lock:
                self.core.tick(at_us, None, None)
                state = self.core.gate.state
            self._note_state(state, at_us)
        return min(super().play(at_us), self._tick_due_us)

    def _note_state(self, state: State, at_us: int) -> None:
        if not self.accepted:
            return
        stands = state not in (State.ACTIVE, State.DEGRADED)
        if stands and (not self.holds or self.holds[-1][1]):
            self.holds.append([at_us, 0])
        elif not stands and self.holds and not self.holds[-1][1]:
            self.holds[-1][1] = at_us

    def _on_sent(self, seq: int, t_us: int) -> None:
        self.core.on_issued(seq, t_us, 0)
        self._sent_us.append(t_us)

    def _publish(self, at_us: int) -> None:
        with self._lock:
            self.core.stream = self._network_core.status(at_us)
            messages = list(self.core.messages(at_us))
        for message in messages:
            self._link.publish(message.channel, message.header, message.payload)

    def _on_token(self, token: str, is_present: bool) -> None:
        with self._lock:
            self.core.on_token(token, is_present, monotonic_us())
            if is_present:
                self._network_core.on_new_driver()

    def _on_answer(self, message: Message) -> None:
        at_us = monotonic_us()
        with self._lock:
            self._answers += 1
            if message.channel is ACK:
                self._network_core.on_ack(message, at_us)
                return
            before = self.core.gate.accepted
            ack = self.core.on_twist(message, at_us)
            if ack is not None:
                self._network_core.on_command_ack(ack, at_us)
            if self.core.gate.accepted > before:
                header = decode(AnswerHeader, message.header)
                self.accepted.append((at_us, header.digest, header.echo.t_us))


if __name__ == "__main__":
    main(Settings.model_validate_json(sys.argv[1]), GatedRobot)
