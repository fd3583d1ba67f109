"""Any message of any channel as text: nothing is lost as JSON; no bytes whatever raise or reach the terminal raw."""

import csv
import json
import math
import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sightline.operator_side.cli.watch import _target_form
from sightline.operator_side.client.messages import (
    MAX_WAITING,
    TARGET_COLUMNS,
    ChannelInbox,
    message_line,
    message_object,
    target_line,
    target_object,
)
from sightline.protocol.channels import CHANNELS, JPEG, SCAN, STATUS, TWIST
from sightline.protocol.log import printable
from sightline.protocol.spec.message_cases import ANSWER, CASES, REPORT, TARGET, USUAL, packed
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.memory import MemoryNetwork


def usual(name, **changed):
    source, header, payload = USUAL[name]
    parts = {"header": packed(header), "payload": payload if isinstance(payload, bytes) else packed(payload)}
    return Message(CHANNELS[name], source, **{**parts, **changed})


@pytest.mark.parametrize("name", CHANNELS)
def test_every_channel_is_one_line_and_one_object(name):
    message = usual(name)
    line, read = message_line(message), message_object(message)
    assert line.startswith(name) and "\n" not in line and "refused" not in line.partition("[")[0].partition(":")[0]
    assert "error" not in read and read["channel"] == name
    assert read["header"]["session"] == USUAL[name][1]["session"]
    assert json.loads(json.dumps(read, allow_nan=False)) == read


def test_images_are_shown_by_size_and_twists_by_numbers():
    assert message_object(usual("overlay"))["payload"] == {"width_px": 640, "height_px": 480, "bytes": 21}
    assert "640x480 JPEG, 21 bytes" in message_line(usual("frame"))
    assert message_line(usual("twist")).startswith("twist/vision #7: +0.2000 m/s -0.3500 rad/s   [")


def test_scan_is_summarized_as_text_and_complete_as_json():
    message = usual("scan", payload=struct.pack("<4f", 0.5, 1.25, math.inf, 8.0))
    assert "4 rays, 3 detect something, nearest 0.50 m" in message_line(message)
    assert message_object(message)["payload"]["ranges_m"] == [0.5, 1.25, None, 8.0]
    assert "nothing near" in message_line(usual("scan", payload=struct.pack("<2f", math.inf, math.inf)))


def test_a_guest_without_a_header_is_shown():
    message = Message(TWIST, "guest", b"", b"0.1|0")
    assert message_line(message) == "twist/guest (no header): +0.1000 m/s +0.0000 rad/s"
    assert message_object(message)["header"] is None


def test_invalid_message_is_shown_with_its_reason():
    message = Message(TWIST, "vision", b"", b"nan|0")
    assert message_line(message) == "twist/vision: invalid: NOT_FINITE: " + message_object(message)["error"][12:]
    assert message_object(message)["payload_bytes"] == 5


@pytest.mark.parametrize(
    "case", [one for one in CASES if one.refuse is None], ids=lambda one: f"{one.channel}/{one.name}"
)
def test_accepted_messages_of_the_specification_are_shown(case):
    _, _, name, *source = case.key.split("/")
    read = message_object(Message(CHANNELS[name], source[0] if source else "", case.header, case.payload))
    assert "error" not in read
    json.dumps(read, allow_nan=False)


def test_message_of_a_peer_cannot_control_the_terminal():
    payload = packed({"state": "HOLD", "reason": "\x1b[2J\x07 gone\u202e", "refused": {"\x1b]0;mine\x07": 3}})
    line = message_line(Message(STATUS, "", packed(USUAL["status"][1]), payload))
    assert line.isprintable() and "gone" in line and "mine" in line
    assert target_line(target_of(label="\x9b2J")).isprintable()
    assert target_line(target_object(usual("report", payload=packed(REPORT | {"phase": "\x1b[2J"})))).isprintable()


@settings(max_examples=30)
@given(st.text(max_size=32), st.text(st.characters(max_codepoint=0x9F), max_size=32))
@example("\x1b[2J", "mine\nr1,0,tracking")
@example('a "quoted", \r\n one', "\x85\u2028")
def test_row_of_a_table_is_one_line_that_cannot_control_the_terminal(phase, detector):
    form = _target_form("r1", as_json=False, as_csv=True)
    row = form(usual("report", payload=packed(REPORT | {"phase": phase, "detector": detector})))
    assert row.isprintable()
    cells = dict(zip(TARGET_COLUMNS, *csv.reader([row]), strict=True))
    assert [cells["phase"], cells["detector"]] == [printable(phase), printable(detector)]


@given(st.sampled_from(list(CHANNELS.values())), st.binary(max_size=80), st.binary(max_size=80))
def test_any_bytes_give_a_line(channel, header, payload):
    message = Message(channel, "vision" if channel.has_source else "", header, payload)
    assert message_line(message).isprintable()
    json.dumps(message_object(message), allow_nan=False)


def test_invalid_ranges_in_scans_are_rejected():
    assert "NOT_FINITE" in message_line(usual(SCAN.name, payload=struct.pack("<f", math.nan)))


# What waits to be printed: of pictures the newest alone, of words some, and never more than a bound.


PICTURES = [name for name, one in CHANNELS.items() if one.encoding == JPEG]


def heard(name, count):
    """An inbox in which `count` messages of a channel arrived, distinguished by the last byte of the payload."""
    network = MemoryNetwork(seed=1)
    inbox = ChannelInbox(network.link("r1", role="operator"), "operator", CHANNELS[name])
    messages = [usual(name, payload=usual(name).payload + bytes([number])) for number in range(count)]
    for message in messages:
        inbox._put(message)
    return inbox, messages


@pytest.mark.parametrize("name", PICTURES)
def test_only_the_newest_image_waits(name):
    inbox, messages = heard(name, 5)
    assert inbox.take(0.0) == messages[-1] and inbox.take(0.0) is None and inbox.dropped == 4


def test_text_messages_wait_in_order_up_to_a_bound():
    inbox, messages = heard("status", MAX_WAITING + 3)
    assert [inbox.take(0.0) for _ in range(MAX_WAITING)] == messages[:MAX_WAITING]
    assert inbox.take(0.0) is None and inbox.dropped == 3


# --- the target of a report --------------------------------------------------------------------------------------


def target_of(**changes):
    return target_object(usual("report", payload=packed(REPORT | {"target": TARGET | changes})))


def test_target_has_every_column_and_the_time_of_its_image():
    target = target_of()
    assert tuple(target) == TARGET_COLUMNS and target["robot"] is None
    assert {name: target[name] for name in TARGET} == TARGET
    assert (target["t_us"], target["phase"], target["detector"]) == (ANSWER["echo"]["t_us"], "driving", "hsv")


@pytest.mark.parametrize(("changes", "line"), [
    ({}, "  +2.9 deg   0.80 m  ball 0.93 at 150,118 px, radius 22.4 of 320x240 (driving)"),
    ({"bearing_rad": None, "distance_m": None, "radius_px": None}, "ball 0.93 at 150,118 px of 320x240 (driving)"),
])
def test_target_is_one_line(changes, line):
    assert target_line(target_of(**changes)) == line


def test_target_of_a_report_of_the_longest_texts_is_read():
    texts = {"refused": "r" * 200, "note": "n" * 200}
    assert target_object(usual("report", payload=packed(REPORT | {"target": TARGET} | texts)))["label"] == "ball"


def test_missing_target_and_invalid_report_are_lines_too():
    assert target_line(target_object(usual("report"))) == "no target (driving)"
    invalid = target_object(usual("report", payload=b"{}"))
    assert tuple(invalid) == TARGET_COLUMNS
    assert target_line(invalid).startswith("no target (invalid report: MALFORMED: MissionReport.mission: ")
