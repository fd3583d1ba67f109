"""The JavaScript peers of examples/js, each in a process of its own. Shell (processes).

Without Node 20 every test that needs it is skipped, and says so.
"""

import json
import re
import shutil
import socket
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.link_rigs import until

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples" / "js"
NODE_AT_LEAST = 20


def node() -> str:
    """Node's path; skips the test where there is none, or one too old."""
    found = shutil.which("node")
    if found is None:
        pytest.skip(f"Node >= {NODE_AT_LEAST} is needed for examples/js, and no `node` is on the PATH")
    version = subprocess.run([found, "--version"], capture_output=True, text=True, timeout=20, check=True).stdout
    if int(re.findall(r"\d+", version)[0]) < NODE_AT_LEAST:
        pytest.skip(f"Node >= {NODE_AT_LEAST} is needed for examples/js, this is {version.strip()}")
    return found


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class JsProcess:
    """`with JsProcess(folder, "robot_server.mjs", "--port", "8765") as robot`: ended at the end."""

    def __init__(self, folder: Path, script: str, *arguments: str, flags: tuple[str, ...] = ()) -> None:
        self._command = [node(), *flags, str(EXAMPLES / script), *arguments]
        self._out = (folder / f"{Path(script).stem}.log").open("a+")
        self.exit_code: int | None = None

    def __enter__(self) -> "JsProcess":
        self.process = subprocess.Popen(self._command, stdout=self._out, stderr=subprocess.STDOUT)
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        self._out.close()

    def end(self) -> int:
        """Ask it to end; its exit code."""
        if self.process.poll() is None:
            self.process.terminate()
        return self.process.wait(5)

    def kill(self) -> None:
        """As a crash would."""
        self.process.kill()
        self.process.wait(5)

    def output(self) -> str:
        """All it has printed."""
        self._out.flush()
        return Path(self._out.name).read_text()

    def says(self, pattern: str, seconds: float = 8.0) -> bool:
        """Whether it prints a line like `pattern` in time."""
        return until(lambda: re.search(pattern, self.output()), seconds)


class JsRobot(JsProcess):
    """A robot called js1 with drawn pictures, on a port of its own; its STOP latch lies in `folder`."""

    def __init__(self, folder: Path, *arguments: str, port: int | None = None) -> None:
        self.port = port or free_port()
        self.endpoint = f"ws://127.0.0.1:{self.port}"
        state = ("--state-dir", str(folder / "state"))
        super().__init__(folder, "robot_server.mjs", "--port", str(self.port), "--robot", "js1", *state, *arguments)

    def __enter__(self) -> "JsRobot":
        super().__enter__()
        assert self.says(r"on wss?://"), self.output()
        return self


class JsVision(JsProcess):
    """A vision for robot `robot` at `endpoint`."""

    def __init__(self, folder: Path, endpoint: str, robot: str, *arguments: str) -> None:
        super().__init__(folder, "vision_client.mjs", "--connect", endpoint, "--robot", robot, *arguments)


def hello(robot: str, wants: list[str] | None = None) -> str:
    """A viewer's."""
    return json.dumps({"v": 1, "robot": robot, "role": "viewer", "session": "99999999", "wants": wants or []})


def json_payload(message: str | bytes) -> dict[str, Any]:
    """Of a binary message of `sightline.v1`."""
    assert isinstance(message, bytes)
    return dict(json.loads(message[2 + int.from_bytes(message[:2]) :]))
