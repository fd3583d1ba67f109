"""Send STOP, reset and arm repeatedly, from a separate process. Shell.

python -m sightline.benchmarks.network.stop_client ENDPOINT ROBOT LEDGER SECONDS SEED
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Final

from sightline.evaluation.faults.evidence import REQUESTED, EventLog
from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import Reply, State, Status, Verb
from sightline.protocol.transports.zenoh.link import open_zenoh

STOPPED: Final = "stopped"
"""Event with the stamp of the first status that reports it."""
RESET: Final = "reset"
"""Recorded just before the request. The wheels stay at zero until then."""
DRIVES_MPS: Final = 0.2
_PATIENCE_S: Final = 20.0
_PAUSE_S: Final = 0.2, 0.8
"""Random pause between driving and STOP, so that STOP meets every phase of the video."""


def run(endpoint: str, robot: str, event_log: EventLog, seconds: float, seed: int) -> None:
    """Run until the time is over. Raises LinkError if the robot does not answer."""
    chance = Random(seed)
    with open_zenoh(robot, connect=[endpoint], role=SOURCE, timeout_s=15) as link:
        operator = Operator(link)
        operator.wait_report(10.0)
        print("person ready", flush=True)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            _until(operator, _drives)
            time.sleep(chance.uniform(*_PAUSE_S))
            event_log.note(REQUESTED)
            operator.stop(lambda: print("a STOP took over 300 ms to be confirmed", flush=True))
            assert operator.report is not None
            event_log.note(STOPPED, operator.report.stamp.t_us)
            _until(operator, lambda status: not any(status.applied))
            event_log.note(RESET)
            _agreed(lambda: operator.request(Verb.RESET))
            _agreed(lambda: operator.arm(_PATIENCE_S))
    print("person done", flush=True)


def _agreed(send: Callable[[], Reply]) -> None:
    """Repeat a request that the robot rejects as too old, because the medium is full."""
    deadline_s = time.monotonic() + _PATIENCE_S
    while not (reply := send()).ok:
        if not reply.detail.startswith(RejectReason.STALE) or time.monotonic() > deadline_s:
            raise SystemExit(f"the robot rejected the request: {reply.detail}")


def _drives(status: Status) -> bool:
    return status.state in (State.ACTIVE, State.DEGRADED) and abs(status.applied[0]) >= DRIVES_MPS


def _until(operator: Operator, happened: Callable[[Status], bool]) -> None:
    deadline_s = time.monotonic() + _PATIENCE_S
    while not happened(status := operator.wait_report().status):
        if time.monotonic() > deadline_s:
            raise SystemExit(f"the robot neither drives nor stands as it should: {status.state}, {status.reason}")


if __name__ == "__main__":
    run(sys.argv[1], sys.argv[2], EventLog(Path(sys.argv[3])), float(sys.argv[4]), int(sys.argv[5]))
