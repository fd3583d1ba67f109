"""The codec kit: our adapter passes every case, each broken one fails its family, and a bad program is one line."""

import json
import math
import os
import sys
import time
from pathlib import Path

import pytest

from sightline.conformance import codec as codec_process
from sightline.conformance.case import Level
from sightline.conformance.codec import (
    CASES,
    END,
    MAX_ANSWER_BYTES,
    VECTORS,
    CodecProgram,
    ProgramError,
    Question,
    codec_cases,
    read_answer,
    read_question,
    run_codec,
    same,
)
from sightline.conformance.runner import Outcome
from sightline.protocol.errors import ConfigError
from tests.conformance.codec_broken import WRONG
from tests.fixtures.javascript import node

ROOT = Path(__file__).parent.parent.parent
ADAPTER = [sys.executable, str(ROOT / "examples" / "codec_adapter.py")]
BROKEN = [sys.executable, "-m", "tests.conformance.codec_broken"]
FEW = [case for case in CASES if case.id.endswith("1") and case.id != END]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def failed(results):
    return {one.case.id: one.reason for one in results if one.outcome is Outcome.FAILED}


def test_our_adapter_passes_every_case():
    seen = []
    results = run_codec(ADAPTER, CASES, seen.append)
    assert seen == results
    assert {one.outcome for one in results} == {Outcome.PASSED}, failed(results)


def test_the_javascript_codec_fails_no_case():
    results = run_codec([node(), "examples/js/codec_adapter.mjs"], CASES)
    assert failed(results) == {}
    assert sum(one.outcome is Outcome.PASSED for one in results) > 200


def test_every_vector_is_a_case_and_every_accepted_message_is_cut():
    vectors = [json.loads(path.read_text("utf-8")) for path in VECTORS.rglob("*.json")]
    asked = codec_cases()
    assert len([one for one in asked if one.family == "vector"]) == len(vectors) >= 207
    cut = [one for one in asked if one.family == "cut"]
    assert len(cut) == sum("key" in vector and "accept" in vector for vector in vectors)
    assert all(any("refusal" in one.expected for one in case.questions()) for case in cut)
    flipped = [one for one in asked if one.family == "flip"]
    assert len(flipped) == sum("accept" in vector and bool(vector.get("header_hex")) for vector in vectors)
    assert {case.level for case in CASES} == set(Level)


@pytest.mark.parametrize("name", WRONG)
def test_a_broken_codec_fails_its_family_and_no_other(name):
    begins = WRONG[name][0]
    wrong = failed(run_codec([*BROKEN, name]))
    assert wrong
    assert all(one.startswith(begins) for one in wrong), wrong
    if name.startswith("takes_nan"):
        titles = [case.title for case in CASES if case.id in wrong]
        assert all("vectors/twist/text_" in title for title in titles) and len(titles) >= 4


def test_a_codec_that_rejects_a_cut_frame_header_passes_every_case():
    assert failed(run_codec([*BROKEN, "needs_whole_frame_headers"])) == {}


def test_a_codec_that_dies_of_one_flipped_bit_fails():
    (case,) = [one for one in CASES if "vectors/twist/usual.json`, one bit" in one.title]
    (reason,) = failed(run_codec([*BROKEN, "dies_of_a_flip"], [case])).values()
    assert reason == "it ended with 7 before it had answered"


@pytest.mark.parametrize(("name", "line"), [
    ("dies", "it ended with 7 before it had answered; it printed 'out of luck'"),
    ("hangs", "no answer within 1 s"),
    ("babbles", r"this line is not JSON: 'Traceback: \x1b[31mno\x1b[0m idea'"),
    ("answers_twice", "an answer has the id 3, which waits for none"),
    ("answers_nothing", "invalid answer: expected exactly one of ok, refusal, unsupported: '{\"id\": 3}'"),
    ("never_ends_its_line", "an answer is longer than 1048576 bytes: 'xxx"),
])
def test_a_bad_program_is_one_line_and_the_end(name, line, monkeypatch):
    monkeypatch.setattr(codec_process, "ANSWER_S", 1.0)
    began_s = time.monotonic()
    results = run_codec([*BROKEN, name], FEW)
    assert time.monotonic() - began_s < 10
    (reason,) = failed(results).values()
    assert reason.startswith(line) and "\n" not in reason
    after = [one.reason for one in results[results.index(next(one for one in results if one.reason == reason)) + 1 :]]
    assert set(after) == {"the program is gone"}


def test_a_program_that_never_answers_is_given_up(monkeypatch):
    monkeypatch.setattr(codec_process, "START_S", 0.3)
    (reason,) = failed(run_codec(["sleep", "60"], FEW)).values()
    assert reason == "no answer within 0.3 s"


def test_a_program_that_does_not_end_with_its_input_fails_that_case_only(monkeypatch):
    monkeypatch.setattr(codec_process, "END_S", 0.5)
    results = run_codec([*BROKEN, "stays"], [*FEW, CASES[-1]])
    assert failed(results) == {END: "it does not end within 0.5 s of its input"}


def test_what_a_program_does_not_know_is_not_applicable():
    results = run_codec([*BROKEN, "knows_messages_only"])
    assert failed(results) == {}
    assert any(one.outcome is Outcome.SKIPPED and "write_twist" in one.reason for one in results)


def test_a_program_that_cannot_be_started_is_a_bad_command():
    with pytest.raises(ConfigError, match="cannot start 'no-such-program': No such file"):
        run_codec(["no-such-program"], FEW)


@pytest.mark.parametrize("size", [1, 5_000, 500_000])
def test_a_program_may_end_before_it_has_read_every_question(size):
    question = Question("text", {"text": "x" * size}, {})
    with CodecProgram(["sh", "-c", """echo '{"id": 1, "ok": {}}'"""]) as program:
        assert [answered for answered, _ in program.request(iter([question]))] == [question]
        program.finish()


def test_nothing_of_a_program_is_left(tmp_path):
    told = tmp_path / "pid"
    run_codec(["sh", "-c", f"sleep 60 & echo $! > {told}; exec cat"], FEW[:1])
    pid = int(told.read_text())
    deadline_s = time.monotonic() + 5
    while _runs(pid) and time.monotonic() < deadline_s:
        time.sleep(0.02)
    assert not _runs(pid)


def _runs(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:  # it ends while its file is read
        return False


@pytest.mark.parametrize(("one", "other", "where"), [
    ({"a": 1}, {"a": 1.0}, ""),
    ({"a": 0}, {"a": -0.0}, ""),
    ([1, "inf"], [1, "inf"], ""),
    ({"a": True}, {"a": 1}, "a: 1 where True is right"),
    ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, "a.b.1: 3 where 2 is right"),
    ({"a": None}, {}, "the answer: {} where {'a': None} is right"),
    ({"a": 1}, {"b": 1}, " fields: ['b'] where ['a'] is right"),
    ("x", 1, "the answer: 1 where 'x' is right"),
])
def test_answers_are_compared_by_value(one, other, where):
    assert same(one, other) == where


@pytest.mark.parametrize(
    "line", [b"", b"[]", b"[" * 100_000, b'{"id":true,"ok":1}', b'{"id":1,"ok":1,"refusal":"x"}', b"1"]
)
def test_invalid_answer_gives_one_error(line):
    with pytest.raises(ProgramError, match=r"^[^\n]{1,300}$"):
        read_answer(line)


def test_a_question_comes_back_from_its_line():
    question = Question("message", {"key": "k", "header": b"\xff", "payload": b""}, {})
    number, kind, fields = read_question(question.line(7))
    assert (number, kind, fields) == (7, "message", {"key": "k", "header": "/w==", "payload": ""})
    assert math.log2(MAX_ANSWER_BYTES) == 20 and os.linesep not in kind
