"""Runs the kit over every peer of this repository and rewrites docs/conformance.md. Shell (processes).

    python -m tests.conformance.page_runs                    # all, one after another: most of an hour
    python -m tests.conformance.page_runs "vision, Zenoh"    # one anew; the others keep their last run

Results lie in runs/conformance, one JSON for each peer; the page is made of what is there.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from sightline.operator_side.setup import keys
from tests.fixtures.javascript import EXAMPLES, ROOT, JsRobot, JsVision, free_port, node
from tests.fixtures.links import free_endpoint, until
from tests.fixtures.robot_process import RobotProcess

SIGHTLINE = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app"]
KEPT = ROOT / "runs" / "conformance"
PAGE = ROOT / "docs" / "conformance.md"
ADAPTER = EXAMPLES.parent / "codec_adapter.py"
START_S = 90.0
TOKEN = "conformance-0123456789abcdef"


def end_at(scheme: str) -> str:
    """An endpoint on loopback that nobody listens on."""
    return free_endpoint().replace("tcp/", scheme)


@contextmanager
def started(*arguments: str, says: str = "") -> Iterator[None]:
    """A command of ours, once it has said a line with `says`; ended at the end."""
    with tempfile.NamedTemporaryFile("w+") as log:
        process = subprocess.Popen([*SIGHTLINE, *arguments], stdout=log, stderr=log)
        try:
            assert until(lambda: says in Path(log.name).read_text(), START_S), Path(log.name).read_text()
            yield
        finally:
            process.terminate()
            process.wait(10)


def conform(name: str, *arguments: str) -> None:
    """One run of the kit; what it finds is kept."""
    KEPT.mkdir(parents=True, exist_ok=True)
    side, *rest = arguments
    options = ["--save", str(file_of(name)), "--name", name]
    print(f"--- {name}", flush=True)
    subprocess.run([*SIGHTLINE, "conform", side, *options, *rest], stdout=subprocess.DEVNULL, check=False)


def file_of(name: str) -> Path:
    """Where a peer's run is kept."""
    return KEPT / f"{name.replace(', ', '-').replace(' ', '-').lower()}.json"


def our_robot(name: str, scheme: str, guarded: bool = False) -> None:
    """Our robot with a simulated lidar that it publishes; its wheels are a log, so it stays where it is."""
    with ExitStack() as ending:
        folder = Path(ending.enter_context(tempfile.TemporaryDirectory()))
        sockets = folder / "sim"
        ending.enter_context(
            started("sim", "--scenario", "static", "--seed", "5", "--socket-dir", str(sockets), says="simulation ready")
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
    """Our vision as a person starts it, with a token where there is one to show."""
    with tempfile.TemporaryDirectory() as folder:
        endpoint, token = end_at(scheme), Path(folder) / "vision.token"
        token.write_text(TOKEN)
        guarded = scheme == "ws://"
        with started("vision", "--connect", endpoint, *(["--secure", folder] if guarded else [])):
            conform(name, "vision", endpoint, *(["--token", str(token)] if guarded else []))


def their_robot(name: str, guarded: bool = False) -> None:
    """The JavaScript robot; with a token only what a token is about, and the rest of its WebSocket."""
    with tempfile.TemporaryDirectory() as folder:
        token = Path(folder) / "token"
        token.write_text(TOKEN)
        options = ["--token-file", str(token)] if guarded else ["--guests"]
        with JsRobot(Path(folder), *options) as robot:
            more = ["--token", str(token), "--group", "websocket"] if guarded else []
            conform(name, "robot", robot.endpoint, "--robot", "js1", *more)


def their_vision(name: str) -> None:
    """The JavaScript vision, with a token."""
    with tempfile.TemporaryDirectory() as folder:
        endpoint, token = f"ws://127.0.0.1:{free_port()}", Path(folder) / "token"
        token.write_text(TOKEN)
        with JsVision(Path(folder), endpoint, "r1", "--token-file", str(token)):
            conform(name, "vision", endpoint, "--token", str(token))


RUNS: dict[str, Callable[[str], None]] = {
    "robot, WebSocket": lambda name: our_robot(name, "ws://"),
    "robot, Zenoh": lambda name: our_robot(name, "tcp/"),
    "robot, wss with keys": lambda name: our_robot(name, "wss://", guarded=True),
    "JavaScript robot, WebSocket": their_robot,
    "JavaScript robot, token": lambda name: their_robot(name, guarded=True),
    "vision, WebSocket": lambda name: our_vision(name, "ws://"),
    "vision, Zenoh": lambda name: our_vision(name, "tcp/"),
    "JavaScript vision, WebSocket": their_vision,
    "codec, Python": lambda name: conform(name, "codec", "--", sys.executable, str(ADAPTER)),
    "codec, JavaScript": lambda name: conform(name, "codec", "--", node(), str(EXAMPLES / "codec_adapter.mjs")),
}


def main(names: Sequence[str]) -> None:
    """Run what is named, or all, and make the page of what is there."""
    for name in names or RUNS:
        RUNS[name](name)
    kept = [str(file_of(name)) for name in RUNS if file_of(name).exists()]
    subprocess.run([*SIGHTLINE, "conform", "page", *kept, "--out", str(PAGE)], check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
