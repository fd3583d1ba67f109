"""Broken codec programs: the example adapter with one thing changed, named on the command line. Shell.

    python -m tests.conformance.codec_broken NAME
"""

import base64
import json
import sys
import time

from examples.codec_adapter import answer

WRONG = {}
"""Name -> (the cases that fail, by the beginning of their ids; what is done instead of printing the answer)."""


def wrong(*cases):
    """Decorator: a change of (question, its right answer) into another answer."""
    def keep(change):
        WRONG[change.__name__] = (cases, change)
        return change
    return keep


@wrong("C-CODEC-1")
def takes_nan(question, right):
    """The grammar of twists: nan and inf are zero."""
    bad = question["kind"] == "message" and right.get("refusal") == "NOT_FINITE" and "/twist/" in question["key"]
    return {"ok": {"source": "vision", "header": {}, "payload": None}} if bad else right


@wrong("C-CODEC-2")
def closes_what_is_cut(question, right):
    """A header without its end is read all the same."""
    cut = base64.b64decode(question.get("header", ""))
    return answer(question | {"header": base64.b64encode(cut + b"}").decode()}) if _cut_at_end(cut) else right


def _cut_at_end(header):
    return header.startswith(b'{"v":1,"source":"vision"') and header.endswith(b'"compute_us":230')


@wrong("C-CODEC-3")
def writes_minus_zero(question, right):
    """Writing: the sign of zero is kept."""
    written = f"{question.get('linear_mps', 0):.4f}|{question.get('angular_rad_s', 0):.4f}"
    return {"ok": written} if question["kind"] == "write_twist" else right


@wrong("C-CODEC-4")
def trips_over_a_flip(question, right):
    """A header whose first brace has another bit is a fault of the program's own."""
    return {"refusal": "CRASHED"} if base64.b64decode(question.get("header", "")).startswith(b"z") else right


@wrong("C-CODEC-1")
def takes_any_hello(question, right):
    """A hello for any robot at all."""
    return {"ok": {}} if question["kind"] == "hello" and "refusal" in right else right


@wrong("C-CODEC-1")
def unmasks_nothing(question, right):
    """The framing of WebSocket: the length is not looked at."""
    return {"ok": {}} if question["kind"] == "websocket" and "refusal" in right else right


@wrong("C-CODEC-1")
def reads_base64_its_way(question, right):
    """Reject each legacy image as MALFORMED, regardless of its text."""
    return {"refusal": "MALFORMED"} if question["kind"] == "older_picture" else right


def takes_everything(question, right):
    """Accept each message, and read nothing in it."""
    return {"ok": {}}


def rejects_everything(question, right):
    """Reject each message for one reason."""
    return {"refusal": "MALFORMED"}


def dies(question, right):
    """In the middle."""
    if question["id"] == 3:
        print("out of luck", file=sys.stderr, flush=True)
        sys.exit(7)
    return right


def dies_of_a_flip(question, right):
    """When the first brace of a header has another bit."""
    if base64.b64decode(question.get("header", "")).startswith(b"z"):
        sys.exit(7)
    return right


def hangs(question, right):
    """In the middle."""
    if question["id"] == 3:
        time.sleep(60)
    return right


def babbles(question, right):
    """In the middle."""
    if question["id"] == 3:
        print("Traceback: \x1b[31mno\x1b[0m idea", flush=True)
    return right


def answers_twice(question, right):
    """In the middle."""
    if question["id"] == 3:
        print(json.dumps({"id": 3, **right}), flush=True)
    return right


def answers_nothing(question, right):
    """An object, but no answer."""
    return {} if question["id"] == 3 else right


def never_ends_its_line(question, right):
    """More than a line may have."""
    if question["id"] == 3:
        print("x" * 2_000_000, end="", flush=True)
        time.sleep(60)
    return right


def stays(question, right):
    """When its input ends: see `main`."""
    return right


def knows_messages_only(question, right):
    """Which is allowed."""
    return right if question["kind"] == "message" else {"unsupported": True}


def needs_whole_frame_headers(question, right):
    """Which is allowed: a JPEG that ends within the components of its frame header is rejected."""
    jpeg = base64.b64decode(question.get("payload", ""))
    if question["kind"] != "message" or "ok" not in right or jpeg[:2] != b"\xff\xd8":
        return right
    at = max(jpeg.find(marker) for marker in (b"\xff\xc0", b"\xff\xc1", b"\xff\xc2"))
    whole = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4]) <= len(jpeg)
    return right if whole else {"refusal": "MALFORMED"}


def main():
    """Answer each question like the example, with the change applied to each answer."""
    name = sys.argv[1]
    change = WRONG[name][1] if name in WRONG else globals()[name]
    for line in sys.stdin:
        question = json.loads(line)
        print(json.dumps({"id": question["id"], **change(question, answer(question))}), flush=True)
    if name == "stays":
        time.sleep(60)


if __name__ == "__main__":
    main()
