"""Run the conformance kit on the JavaScript peers like a third party. Every MUST and SHOULD passes."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from sightline import conformance
from sightline.evaluation.processes import SIGHTLINE
from tests.fixtures.javascript import EXAMPLES, JsRobot, JsVision, node
from tests.fixtures.ports import free_port

CONFORM = [*SIGHTLINE, "conform"]
NOT_APPLICABLE = (
    "over WebSocket nothing is sent under a key",
    "no token was named",
    "no keys were named",
    "it publishes no reports",
    "it publishes no detections",
    "it does not steer by the boxes of",
    "this robot publishes no scans",
    "the robot declares no liveliness token",
    "no port of the legacy protocol was named",
    "the program does not know questions of kind stop",
)


def report(*arguments: str, seconds: float) -> dict[str, Any]:
    """Return the JSON of the kit."""
    run = subprocess.run([*CONFORM, *arguments], check=False, capture_output=True, text=True, timeout=seconds)
    assert run.stdout.startswith("{"), run.stdout + run.stderr
    return dict(json.loads(run.stdout))


def failed(results: dict[str, Any]) -> list[str]:
    """Return the cases that failed, or that do not apply for an unknown reason."""
    return [
        f"{one['name']} {one['level']}: {one['title']} {one['reason']}"
        for one in results["checks"]
        if one["value"] != "passed" and not one["reason"].startswith(NOT_APPLICABLE)
    ]


@pytest.mark.parametrize("reason", NOT_APPLICABLE)
def test_a_known_reason_is_one_that_the_kit_gives(reason: str) -> None:
    folder = Path(conformance.__file__).parent
    assert any(reason.removesuffix(" stop") in one.read_text("utf-8") for one in folder.rglob("*.py"))


def test_javascript_codec_conforms():
    results = report("codec", "--json", "--", node(), str(EXAMPLES / "codec_adapter.mjs"), seconds=120)
    assert failed(results) == []
    assert results["ok"] and len(results["checks"]) >= 390


@pytest.mark.long
def test_javascript_robot_conforms(tmp_path):
    with JsRobot(tmp_path, "--guests") as robot:
        results = report("robot", robot.endpoint, "--robot", "js1", "--json", seconds=580)
    assert failed(results) == []
    assert results["ok"] and len(results["checks"]) >= 60


@pytest.mark.long
def test_javascript_vision_conforms(tmp_path):
    endpoint = f"ws://127.0.0.1:{free_port()}"
    with JsVision(tmp_path, endpoint, "r1") as vision:
        results = report("vision", endpoint, "--json", seconds=580)
        assert vision.process.poll() is None, vision.output()
    assert failed(results) == []
    assert results["ok"] and len(results["checks"]) >= 60
