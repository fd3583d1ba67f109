"""Run the kit on every peer of this repository and rewrite docs/reference/results/conformance.md.

    python -m docs.make.conformance                    # all in turn: most of an hour
    python -m docs.make.conformance "vision, Zenoh"    # only this one; the others keep their last run

Results are in runs/conformance, one JSON file per peer. The page shows all of them.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sightline.conformance.runner import Outcome, printable
from sightline.evaluation.processes import SIGHTLINE
from sightline.operator_side.setup import keys
from tests.fixtures.javascript import EXAMPLES, ROOT, JsRobot, JsVision, node
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint, free_port
from tests.fixtures.robot_process import RobotProcess

KEPT = ROOT / "runs" / "conformance"
PAGE = ROOT / "docs" / "reference" / "results" / "conformance.md"
ADAPTER = EXAMPLES.parent / "codec_adapter.py"
MARKS = {Outcome.PASSED: "ok", Outcome.FAILED: "FAIL", Outcome.SKIPPED: "n/a"}
START_S = 90.0
TOKEN = "conformance-0123456789abcdef"

PREFACE = """`python -m docs.make.conformance` runs the kit over these peers and writes this page. A case that a peer's
choices leave nothing to test in (no guests, scan, token or STOP port, no port of the legacy protocol, another
transport) counts as not applicable. Most cases of a vision service need its twists, so one that never drives does not
conform. Nor does a peer with a MUST that was left although the cases of what it needs passed.
The minimal peers are the examples of [Implement a peer](../../tutorials/implement-a-peer.md): they leave out clauses on
purpose and therefore do not conform.
Clauses are those of [protocol/README.md](https://github.com/sightline-robot/sightline/blob/main/protocol/README.md)."""

UNSEEN = """## Not visible over the wire

The kit evaluates what a robot publishes: `applied`, and the measured motion in `moving`, `pose` and `odometry`. A robot
can lie about all of them. The kit does not see:

- **Wheels that turn while the odometry stands still**, or a robot without odometry. `sightline conform robot
  --motor-log FILE` reads the wheel speeds that the drive was given (`t_us,left_rad_s,right_rad_s`) as a second witness.
- **Motors that ignore their driver.** No file of the robot shows them. Look at the wheels.
- **Motion below 0.03 m/s and 0.15 rad/s**, which is noise of a coarse encoder, and a single reading above it.
- **Wheels that do not turn when they should.** A robot without encoders reports zero as well, so R-LIM-08 is not
  applicable to it.
- **The time between a command and the motor**, except as far as the robot's own clock reports it. Stop times are
  measured to 0.1 s by `status` and 0.2 s by motion.
- **What a vision service follows.** The cases about the axes use a yellow ball. They are not applicable to a service
  whose twists do not depend on it (V-STEER-10).
- **A STOP that is forgotten over a restart** (6.3, 6.5): the kit restarts no robot.
- **A robot that takes an ack with a payload**, or on WebSocket one whose header names another source than its key.
- **The power supply, the emergency stop and the hardware watchdog.**"""

LISTED_ELSEWHERE = ("codec",)
"""Sides without a table of each case. The cases of a codec are the golden vectors, and each describes itself."""


def end_at(scheme: str) -> str:
    """Return a free endpoint on loopback."""
    return free_endpoint(scheme)


@contextmanager
def started(*arguments: str, prints: str = "") -> Iterator[None]:
    """Run a command of Sightline. The block starts after it printed `prints`; the command ends with the block."""
    with tempfile.NamedTemporaryFile("w+") as log:
        process = subprocess.Popen([*SIGHTLINE, *arguments], stdout=log, stderr=log)
        try:
            assert until(lambda: prints in Path(log.name).read_text(), START_S), Path(log.name).read_text()
            yield
        finally:
            process.terminate()
            process.wait(10)


def conform(name: str, *arguments: str) -> None:
    """Run the kit once and store its result with the date. Raises RuntimeError without a result."""
    KEPT.mkdir(parents=True, exist_ok=True)
    side, *rest = arguments
    file = file_of(name)
    file.unlink(missing_ok=True)  # otherwise the page would show an earlier run as this one
    print(f"--- {name}", flush=True)
    done = subprocess.run([*SIGHTLINE, "conform", side, "--save", str(file), "--name", name, *rest],
                          stdout=subprocess.DEVNULL, check=False)
    if not file.exists():
        raise RuntimeError(f"{name}: the kit ended with {done.returncode} and without a result")
    file.write_text(json.dumps({**json.loads(file.read_text()), "measured": f"{datetime.now(UTC):%Y-%m-%d}"}))


def file_of(name: str) -> Path:
    """Return the file with the result of a peer's run."""
    return KEPT / f"{name.replace(', ', '-').replace(' ', '-').lower()}.json"


def our_robot(name: str, scheme: str, guarded: bool = False) -> None:
    """Test our robot with a simulated lidar that it publishes. Its wheels are a log, so it does not move."""
    with ExitStack() as ending:
        folder = Path(ending.enter_context(tempfile.TemporaryDirectory()))
        sockets = folder / "sim"
        ending.enter_context(
            started("sim", "--scenario", "static", "--seed", "5", "--socket-dir", str(sockets),
                    prints="simulation ready")
        )
        endpoint, older = end_at(scheme), end_at("ws-legacy://")
        secure = str(folder / "keys") if guarded else ""
        if guarded:
            keys.make(Path(secure), [])
        lidar = {"kind": "sim", "options": {"socket_dir": str(sockets)}}
        listen = [endpoint] if guarded else [endpoint, older]
        changes = {"listen": listen, "secure": secure, "safety": {"guests": not guarded}, "range_sensor": lidar}
        robot = ending.enter_context(RobotProcess(folder, **changes))
        assert until(lambda: endpoint in robot.output(), START_S), robot.output()
        more = ["--secure", secure] if guarded else ["--older", older]
        conform(name, "robot", endpoint, *more)


def our_vision(name: str, scheme: str) -> None:
    """Test the vision service as an operator starts it, with a token if there is one."""
    with tempfile.TemporaryDirectory() as folder:
        endpoint, token = end_at(scheme), Path(folder) / "vision.token"
        token.write_text(TOKEN)
        guarded = scheme == "ws://"
        with started("vision", "--connect", endpoint, *(["--secure", folder] if guarded else [])):
            conform(name, "vision", endpoint, *(["--token", str(token)] if guarded else []))


def their_robot(name: str, guarded: bool = False) -> None:
    """Test the JavaScript robot; with a token only the token cases and the rest of its WebSocket."""
    with tempfile.TemporaryDirectory() as folder:
        token = Path(folder) / "token"
        token.write_text(TOKEN)
        options = ["--token-file", str(token)] if guarded else ["--guests"]
        with JsRobot(Path(folder), *options) as robot:
            more = ["--token", str(token), "--group", "websocket"] if guarded else []
            conform(name, "robot", robot.endpoint, "--robot", "js1", *more)


def their_vision(name: str) -> None:
    """Test the JavaScript vision service, with a token."""
    with tempfile.TemporaryDirectory() as folder:
        endpoint, token = f"ws://127.0.0.1:{free_port()}", Path(folder) / "token"
        token.write_text(TOKEN)
        with JsVision(Path(folder), endpoint, "r1", "--token-file", str(token)):
            conform(name, "vision", endpoint, "--token", str(token))


def minimal_robot(name: str, transport: str) -> None:
    """Test the example without Sightline. It declares the parts that it leaves out, so it does not conform."""
    endpoint, port = minimal_end(transport)
    with subprocess.Popen([sys.executable, EXAMPLES.parent / "minimal_robot.py", transport, str(port),
                           EXAMPLES.parent / "pictures"], stdout=subprocess.DEVNULL) as robot:
        conform(name, "robot", endpoint)
        robot.kill()


def minimal_vision(name: str, transport: str) -> None:
    """Test the example without Sightline. On Zenoh it ends without a robot, so it restarts until the kit listens."""
    endpoint, _ = minimal_end(transport)
    command = f"until {sys.executable} {EXAMPLES.parent / 'minimal_vision.py'} {endpoint}; do sleep 0.2; done"
    with subprocess.Popen(["/bin/sh", "-c", command], start_new_session=True, stdout=subprocess.DEVNULL,
                          stderr=subprocess.DEVNULL) as vision:
        conform(name, "vision", endpoint)
        os.killpg(vision.pid, signal.SIGKILL)


def minimal_end(transport: str) -> tuple[str, int]:
    port = free_port()
    return f"{'ws://' if transport == 'ws' else 'tcp/'}127.0.0.1:{port}", port


RUNS: dict[str, Callable[[str], None]] = {
    "robot, WebSocket": lambda name: our_robot(name, "ws://"),
    "robot, Zenoh": lambda name: our_robot(name, "tcp/"),
    "robot, wss with keys": lambda name: our_robot(name, "wss://", guarded=True),
    "JavaScript robot, WebSocket": their_robot,
    "JavaScript robot, token": lambda name: their_robot(name, guarded=True),
    "vision, WebSocket": lambda name: our_vision(name, "ws://"),
    "vision, Zenoh": lambda name: our_vision(name, "tcp/"),
    "JavaScript vision, WebSocket": their_vision,
    "minimal robot, WebSocket": lambda name: minimal_robot(name, "ws"),
    "minimal robot, Zenoh": lambda name: minimal_robot(name, "zenoh"),
    "minimal vision, WebSocket": lambda name: minimal_vision(name, "ws"),
    "minimal vision, Zenoh": lambda name: minimal_vision(name, "zenoh"),
    "codec, Python": lambda name: conform(name, "codec", "--", sys.executable, str(ADAPTER)),
    "codec, JavaScript": lambda name: conform(name, "codec", "--", node(), str(EXAMPLES / "codec_adapter.mjs")),
}


def to_page(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return the page of several runs (their JSON): peers, cases that did not pass the first time, all cases."""
    lines = ["# Conformance", "", PREFACE, ""]
    lines += ["| peer | side | conforms | passed | failed | SHOULD failed | not applicable | cases | measured |",
              "|" + "---|" * 9]
    for run in runs:
        found = run["counts"]
        figures = (found.get(name, 0) for name in ("passed", "failed", "SHOULD failed", "not applicable"))
        row = [run["peer"], run["side"], "yes" if run["ok"] else "no", *figures, len(run["checks"]),
               run.get("measured", "")]
        lines.append("| " + " | ".join(str(cell) for cell in row) + " |")
    lines += ["", UNSEEN]
    for run in runs:
        lines += remarks(run)
    for side in dict.fromkeys(run["side"] for run in runs if run["side"] not in LISTED_ELSEWHERE):
        lines += case_table(side, [run for run in runs if run["side"] == side])
    return "\n".join(lines) + "\n"


def remarks(run: Mapping[str, Any]) -> list[str]:
    noted = [check for check in run["checks"] if check["reason"]]
    if not noted:
        return []
    alike: dict[tuple[str, str], list[str]] = {}
    for one in noted:
        alike.setdefault((one["value"], one["reason"]), []).append(one["name"])
    lines = ["", f"## {run['peer']}: what did not pass at once", "", "| cases | outcome | why |", "|---|---|---|"]
    return lines + [f"| {', '.join(names)} | {what} | {cell(why)} |" for (what, why), names in alike.items()]


def case_table(side: str, runs: Sequence[Mapping[str, Any]]) -> list[str]:
    peers = [run["peer"] for run in runs]
    lines = ["", f"## Cases: {side}", "", f"| case | | clause | what | {' | '.join(peers)} |",
             "|" + "---|" * (4 + len(peers))]
    outcomes = [{check["name"]: MARKS[Outcome(check["value"])] for check in run["checks"]} for run in runs]
    cases = {check["name"]: check for run in runs for check in run["checks"]}
    for name, check in cases.items():
        found = " | ".join(outcome.get(name, "") for outcome in outcomes)
        lines.append(f"| {name} | {check['level']} | {check['clause']} | {cell(check['title'])} | {found} |")
    return lines


def cell(text: str) -> str:
    return " ".join(printable(text).replace("|", "\\|").split())


def main(names: Sequence[str]) -> None:
    """Run the named peers, or all, and write the page from all results."""
    for name in names or RUNS:
        RUNS[name](name)
    PAGE.write_text(to_page([json.loads(file_of(name).read_text()) for name in RUNS if file_of(name).exists()]))


if __name__ == "__main__":
    main(sys.argv[1:])
