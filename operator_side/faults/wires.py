"""The bench's end of `sim/tun_emulator.py`: two namespaces and the wire between them, shaped while it runs. Shell."""

import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

from sightline.protocol.errors import HardwareError
from sightline.sim.network_emulator import LinkShapes
from sightline.sim.tun_emulator import namespaces

_END_S: Final = 2.0
_PLAIN: Final = ("taken", "delivered", "delivered_bytes")


class BenchWire:
    """`ab` is from the robot, `ba` towards it. Use it in a `with`."""

    def __init__(self, log: Path) -> None:
        self.robot_side, self.far_side = (f"sightline-{os.getpid()}-{end}" for end in "ab")
        self._log = log
        self._ending = ExitStack()
        self._process: subprocess.Popen[str] | None = None
        self.carried_bytes = {"ab": 0, "ba": 0}
        """What came out at the far end of each direction, up to the last `shape`."""

    def __enter__(self) -> Self:
        with self._ending:
            self._ending.enter_context(namespaces(self.robot_side, self.far_side))
            log = self._ending.enter_context(self._log.open("wb"))
            self._process = subprocess.Popen(
                [sys.executable, "-u", "-m", "sightline.sim.tun_emulator", self.robot_side, self.far_side],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True,
            )
            self._ending.callback(self._end, self._process)
            if "ready" not in _file(self._process.stdout).readline():
                raise HardwareError(f"the wire does not start; see {self._log}")
            self._ending = self._ending.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.close()

    def shape(self, shapes: LinkShapes) -> int:
        """Put `shapes` in force; returns how many packets the wire has harmed so far."""
        assert self._process is not None
        stdin = _file(self._process.stdin)
        stdin.write(shapes.model_dump_json() + "\n")
        stdin.flush()
        counts = json.loads(_file(self._process.stdout).readline())
        self.carried_bytes = {leg: count["delivered_bytes"] for leg, count in counts.items()}
        return sum(count for leg in counts.values() for name, count in leg.items() if name not in _PLAIN)

    @staticmethod
    def _end(process: subprocess.Popen[str]) -> None:
        _file(process.stdin).close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _file(pipe: IO[str] | None) -> IO[str]:
    assert pipe is not None
    return pipe
