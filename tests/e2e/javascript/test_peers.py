"""Run the unit tests of the JavaScript peers, check their size, and compare their codec with the Python codec."""

import base64
import json
import random
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sightline.protocol.spec import golden
from sightline.protocol.spec.generate import json_schema
from tests.fixtures.javascript import EXAMPLES, ROOT, node

VECTORS = ROOT / "protocol" / "vectors"
SOURCES = sorted(path for path in EXAMPLES.iterdir() if path.suffix in (".mjs", ".html"))


@pytest.mark.slow
def test_javascript_unit_tests_pass():
    run = subprocess.run([node(), "--test", str(EXAMPLES)], check=False, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stdout[-4000:]
    assert int(re.findall(r"^# pass (\d+)", run.stdout, re.MULTILINE)[0]) >= 90


def test_page_shows_nothing_old_as_new():
    run = subprocess.run([node(), "--test", str(Path(__file__).parent / "page.test.mjs")],
                         check=False, capture_output=True, text=True, timeout=30)
    assert run.returncode == 0, run.stdout[-4000:]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_files_are_short_and_state_their_purpose(path):
    source = path.read_text("utf-8")
    assert source.count("\n") <= 300
    if path.suffix == ".mjs":
        assert source.startswith(("/**\n * @file ", "/** @file "))
        head = source.split("*/")[0]
        assert path.name.endswith(".test.mjs") or ("Pure" in head) != ("Shell" in head)
        if "Pure" in head:
            assert not re.search(r'from "node:|\bperformance\b|Date\.now|setTimeout|Math\.random', source)


def test_viewer_is_served_with_each_module_that_it_imports():
    needed, left = set(), {"page"}
    while left:
        needed |= left
        sources = "".join((EXAMPLES / f"{name}.mjs").read_text("utf-8") for name in left)
        left = set(re.findall(r'^(?:import\b|\}).*?\bfrom "\./(\w+)\.mjs"', sources, re.MULTILINE)) - needed
    (served,) = re.findall(r"MODULES = \[(.*?)\]", (EXAMPLES / "pages.mjs").read_text("utf-8"))
    assert needed == set(re.findall(r'"(\w+)"', served))


def test_javascript_imports_only_the_platform():
    for path in SOURCES:
        source = re.sub(r"/\*.*?\*/", "", path.read_text("utf-8"), flags=re.DOTALL)
        imported = re.findall(r'^\s*(?:import\b|\}).*?\bfrom "([^"]+)"', source, re.MULTILINE)
        assert not re.search(r"\bimport\(|\brequire\(|src=.https?:", source)
        assert all(name.startswith(("node:", "./")) for name in imported), path.name


@pytest.mark.parametrize(
    "model", ["FrameHeader", "AnswerHeader", "RequestHeader", "Status", "StreamStatus", "CameraModel", "Detections"]
)
def test_javascript_field_tables_have_the_same_fields_in_the_same_order(model):
    """Check that a new field is in both languages. A missing default is not visible in any message."""
    assert _js_fields(model) == list(json_schema()["$defs"][model]["properties"])


def _js_fields(model: str) -> list[str]:
    script = "import * as tables from './fields.mjs'; console.log(JSON.stringify(Object.keys(tables[process.argv[1]])))"
    run = subprocess.run(
        [node(), "--input-type=module", "-e", script, model],
        capture_output=True, text=True, cwd=EXAMPLES, timeout=20, check=True,
    )  # fmt: skip
    fields: list[str] = json.loads(run.stdout)
    return fields


def _messages() -> list[tuple[str, bytes, bytes]]:
    vectors = [json.loads(path.read_text("utf-8")) for path in sorted(VECTORS.rglob("*.json"))]
    return [
        (one["key"], bytes.fromhex(one["header_hex"]), bytes.fromhex(one["payload_hex"]))
        for one in vectors
        if "header_hex" in one
    ]


def _mutated(seed: int, count: int) -> Iterator[tuple[str, bytes, bytes]]:
    """Yield golden messages with bytes changed, removed, doubled, or replaced by difficult JSON."""
    dice = random.Random(seed)
    parts = (b"1e5", b"-0", b"7.0", b"null", b"true", b'"', b"\\ud800", b"\xff", b"{}", b"[", b",", b"9" * 30, b" ")
    messages = _messages()
    for _ in range(count):
        key, *body = dice.choice(messages)
        which = dice.randrange(2)
        data = bytearray(body[which])
        for _ in range(dice.randint(1, 3)):
            at = dice.randrange(len(data) + 1)
            end = min(len(data), at + dice.choice((0, 1, 1, 2, 8)))
            data[at:end] = dice.choice((b"", bytes([dice.randrange(256)]), dice.choice(parts), data[at:end] * 2))
        body[which] = bytes(data)
        yield key, body[0], body[1]


def _js_outcomes(messages: list[tuple[str, bytes, bytes]]) -> list[Any]:
    lines = [
        json.dumps({"id": number, "kind": "message", "key": key,
                    "header": base64.b64encode(header).decode(), "payload": base64.b64encode(payload).decode()})
        for number, (key, header, payload) in enumerate(messages)
    ]  # fmt: skip
    run = subprocess.run(
        [node(), str(EXAMPLES / "codec_adapter.mjs")], input="\n".join(lines) + "\n",
        check=False, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    answers = [_by_value(line) for line in run.stdout.splitlines()]
    assert [answer.pop("id") for answer in answers] == list(range(len(messages)))
    return answers


def _by_value(text: str) -> Any:
    """Parse JSON with every number as a double, because JavaScript rounds the digits of large ones."""
    return json.loads(text, parse_int=float)


def _is_allowed_to_differ(header: bytes, payload: bytes) -> bool:
    """Return True for NaN, Infinity or deep nesting in an ignored field, which clauses 2.1 and 2.2 leave open."""
    both = header + payload
    return any(word in both for word in (b"NaN", b"Infinity", b"[" * 20, b"{" * 20))


@pytest.mark.parametrize("seed", [20_240_601, 77, 1234])
def test_both_codecs_read_mutated_messages_alike(seed):
    messages = list(_mutated(seed, 3000))
    ours = [golden.outcome(*message) for message in messages]
    accepted = 0
    for message, mine, theirs in zip(messages, ours, _js_outcomes(messages), strict=True):
        expected = {"ok": mine["accept"]} if "accept" in mine else {"refusal": mine["refuse"]}
        accepted += "ok" in expected
        assert theirs == _by_value(json.dumps(expected)) or _is_allowed_to_differ(*message[1:]), message
    assert 100 < accepted < 2900


def test_adapter_reports_unsupported_cases():
    questions = ({"id": 3, "kind": "poem"}, {"id": 4, "kind": "write_twist", "linear_mps": 0.2, "angular_rad_s": -1e-5})
    run = subprocess.run(
        [node(), str(EXAMPLES / "codec_adapter.mjs")], input="\n".join(map(json.dumps, questions)) + "\n",
        capture_output=True, text=True, timeout=20, check=True,
    )  # fmt: skip
    assert [json.loads(line) for line in run.stdout.splitlines()] == [
        {"id": 3, "unsupported": True},
        {"id": 4, "ok": "0.2000|0.0000"},
    ]


def test_page_does_not_call_stop_an_emergency_stop():
    """No network button is an emergency stop, and no text calls it one."""
    for path in [*SOURCES, Path(ROOT / "docs" / "reference" / "javascript.md")]:
        text = re.sub("no emergency stop|not an emergency stop", "", path.read_text("utf-8"))
        assert not re.search(r"emergency\s*stop|e-stop|not-?aus", text, re.IGNORECASE)
    assert ">STOP<" in (EXAMPLES / "viewer.html").read_text("utf-8")
