"""The commands of the tutorials and of the README, executed as the pages show them.

`<!-- run: NAME -->` before a block of shell commands makes this module run the block. `tests/docs/test_pages.py`
requires that comment, or a reason, before each one. Ports and folders come from the environment, not from the commands.
"""

import os
import re
import shlex
import shutil
import subprocess
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest

from sightline.evaluation.processes import SIGHTLINE
from sightline.vision_side.detect.onnx.detector import NANODET
from tests.fixtures.commands import service
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parent.parent.parent
BLOCK = re.compile(r"<!-- run: (\w+) -->\n```sh\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL)
READY = {"sim": "simulation ready", "robot": "robot r1: on", "vision": "vision: frames from robot r1"}


def blocks(page: str) -> dict[str, list[list[str]]]:
    """Return the commands of each marked block of a page, without `sightline`, comments and empty lines."""
    found = {}
    for name, text, _ in BLOCK.findall((ROOT / page).read_text("utf-8")):
        lines = [shlex.split(line, comments=True) for line in text.splitlines()]
        assert all(words[0] == "sightline" for words in lines if words), lines
        found[name] = [words[1:] for words in lines if words]
    return found


def shown(page: str) -> dict[str, str]:
    """Return the output that a page shows below each marked block."""
    return {name: output for name, _, output in BLOCK.findall((ROOT / page).read_text("utf-8")) if output}


class Terminals:
    """Run commands in the folder of the repository, as a reader does; services stay until the end."""

    def __init__(self, folder: Path, ending: ExitStack) -> None:
        self._folder, self._ending = folder, ending
        endpoint = free_endpoint()
        sockets = ending.enter_context(tempfile.TemporaryDirectory(prefix="tutorial-", dir="/tmp"))  # short enough
        self._env = {
            **os.environ, "TMPDIR": sockets, "HOME": str(folder), "XDG_RUNTIME_DIR": str(folder),
            "XDG_CONFIG_HOME": str(folder / "config"), "PYTHONUNBUFFERED": "1", "SIGHTLINE_CONNECT": endpoint,
            "SIGHTLINE_ROBOT__STATE_DIR": str(folder / "state"),
            "SIGHTLINE_ROBOT__LISTEN": f'["{endpoint}"]', "SIGHTLINE_VISION__CONNECT": f'["{endpoint}"]',
        }  # fmt: skip

    def run(self, commands: list[list[str]]) -> str:
        """Run each command in turn; return the output of the last one."""
        output = ""
        for words in commands:
            if words[0] in READY:
                self._ending.enter_context(
                    service(self._command(words), READY[words[0]], self._folder, 40, cwd=ROOT, env=self._env)
                )
            else:
                output = self._once(words)
        return output

    def _command(self, words: list[str]) -> list[str]:
        return [*SIGHTLINE, *words]

    def _once(self, words: list[str]) -> str:
        done = subprocess.run(self._command(words), cwd=ROOT, env=self._env, capture_output=True, text=True,
                              timeout=240, check=False)
        assert done.returncode == 0, (words, done.stdout, done.stderr)
        return done.stdout


@pytest.fixture
def terminals(tmp_path):
    with ExitStack() as ending:
        yield Terminals(tmp_path, ending)


def test_first_drive_starts_arms_drives_stops_and_drives_again(terminals):
    page, outputs = blocks("docs/tutorials/first-drive.md"), shown("docs/tutorials/first-drive.md")
    assert list(page) == ["services", "arm", "drive", "stop", "again", "harder"]
    terminals.run(page["services"])
    assert terminals.run(page["arm"]) == outputs.pop("arm")
    assert until(lambda: "ACTIVE" in terminals.run(page["drive"]), 30)
    assert terminals.run(page["stop"]) == outputs.pop("stop")
    assert not outputs
    assert "armed" in terminals.run(page["again"])


@pytest.mark.alone  # it must reach the bounds of its scenario
def test_first_drive_drives_over_a_harder_link(terminals, tmp_path):
    [words] = blocks("docs/tutorials/first-drive.md")["harder"]
    assert "acquired_s" in terminals.run([[*words, "--out", str(tmp_path / "run")]])


def test_readme_starts_three_services_and_the_operator_commands(terminals):
    page = blocks("README.md")
    assert list(page) == ["services", "arm"]
    terminals.run(page["services"])
    assert "reset" in terminals.run(page["arm"])


@pytest.mark.alone
def test_own_model_is_checked_scored_and_drives(terminals, tmp_path):
    """NanoDet stands for the reader's YOLO: it has the same labels, and an output of the same form."""
    page = "docs/tutorials/your-own-model.md"
    steps = {name: [[word.replace("yolo11n.onnx", str(tmp_path / "yolo11n.onnx")).replace(
        "vision.toml", str(tmp_path / "vision.toml")) for word in words] for words in commands]
        for name, commands in blocks(page).items()}
    assert list(steps) == ["check", "score", "demo", "configure"]
    shutil.copy(NANODET, tmp_path / "yolo11n.onnx")
    assert "FAIL" not in terminals.run(steps["check"])
    assert "yolo11n.onnx" in terminals.run(steps["score"])
    [words] = steps["demo"]
    assert "acquired_s" in terminals.run([[*words, "--out", str(tmp_path / "run")]])
    [settings] = re.findall(r"```toml\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    (tmp_path / "vision.toml").write_text(settings.replace("yolo11n.onnx", str(tmp_path / "yolo11n.onnx")))
    terminals.run(steps["configure"])
