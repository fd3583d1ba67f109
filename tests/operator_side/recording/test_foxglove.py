"""Recordings open in other tools: each valid message has a schema, and still returns byte for byte."""

import base64
import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from mcap.reader import make_reader
from mcap.writer import Writer

from sightline.operator_side.recording import foxglove
from sightline.operator_side.recording.recorder import ENCODING, read_recording
from sightline.protocol.channels import CAMERA, CHANNELS, DETECTIONS, FRAME, SCAN, STATUS, TWIST, parse_key
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import CameraModel, FrameHeader, ScanHeader, Stamp
from sightline.protocol.transports.link import Message
from tests.operator_side.recording.test_recorder import record

VECTORS = Path(__file__).parents[3] / "protocol" / "vectors"
STAMP = {"session": "0000000a", "seq": 1, "t_us": 2}
COMMON = settings(max_examples=30)
METERS = st.floats(-50, 50, width=32)


@cache
def golden() -> list[tuple[Message, bool]]:
    """Each message of the golden vectors, and whether a receiver accepts it."""
    found = []
    for channel in CHANNELS:
        for file in sorted((VECTORS / channel).glob("*.json")):
            case = json.loads(file.read_text())
            parsed = parse_key(case["key"])
            if parsed is not None:
                header, payload = (bytes.fromhex(case[name]) for name in ("header_hex", "payload_hex"))
                found.append((Message(parsed[1], parsed[2], header, payload), "accept" in case))
    return found


def strict(data: bytes):
    """Decode JSON as a browser does, without Infinity and NaN."""
    return json.loads(data, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def without_null(value):
    if isinstance(value, dict):
        return {name: without_null(one) for name, one in value.items() if one is not None}
    return value


def shown(path: Path, message: Message) -> dict[str, dict]:
    """Record one message; return what another tool reads, by the name of the schema."""
    record(path, [message])
    with path.open("rb") as file:
        read = list(make_reader(file).iter_messages())
    for schema, channel, one in read:
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        time = strict(one.data).get("timestamp", {"sec": one.log_time // 10**9, "nsec": one.log_time % 10**9})
        assert time["sec"] * 10**9 + time["nsec"] == one.log_time == one.publish_time
    return {schema.name: strict(one.data) for schema, _, one in read}


@pytest.fixture
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("foxglove") / "run.mcap"


@pytest.mark.parametrize("channel", CHANNELS.values())
def test_golden_messages_return_exactly_and_the_accepted_ones_fit_their_schema(path, channel):
    messages, is_accepted = zip(*(one for one in golden() if one[0].channel is channel), strict=True)
    record(path, messages)
    assert [one.message for one in read_recording(path)] == list(messages)
    with path.open("rb") as file:
        read = [one for one in make_reader(file).iter_messages() if one[1].topic != foxglove.TRANSFORM]
    accepted = [one for one, good in zip(read, is_accepted, strict=True) if good]
    assert accepted
    for schema, found, message in accepted:
        assert (schema.name, schema.data) == foxglove.schema_of(channel)
        assert (schema.encoding, found.message_encoding) == ("jsonschema", "json")
        Draft202012Validator(json.loads(schema.data)).validate(without_null(strict(message.data)))


def kinds(schema: dict) -> set[str]:
    """Walk through a schema as Lichtblick does, which rejects a file for any other kind."""
    if schema["type"] == "object":
        return {"object"}.union(*(kinds(one) for one in schema["properties"].values()))
    if schema["type"] == "array":
        assert schema["items"]["type"] != "array"
        return {"array"} | kinds(schema["items"])
    assert schema["type"] in ("boolean", "string", "number", "integer")
    return {schema["type"]}


@pytest.mark.parametrize("channel", [*CHANNELS.values(), None])
def test_schema_has_only_what_viewers_read(channel):
    name, data = foxglove.schema_of(channel)
    schema = json.loads(data)
    assert "header" not in schema["properties"], "which makes it a message of ROS"
    assert schema["title"] == name and {"object", "number", "integer"} & kinds(schema)
    if channel is not None:
        assert set(schema["properties"]["message_header"]["properties"]) == set(channel.header.model_fields)
        kind = {STATUS: "object", TWIST: "string"}.get(channel)
        assert kind in (None, schema["properties"]["data"]["type"])


def test_schema_has_nullable_fields_and_leaves_out_arrays_of_arrays():
    status, mission, detections = (
        json.loads(foxglove.schema_of(CHANNELS[name])[1])["properties"]["data"]["properties"]
        for name in ("status", "mission", "detections")
    )
    assert status["frame_age_us"] == {"type": "integer"} and status["state"] == {"type": "string"}
    assert status["applied"] == {"type": "array", "items": {"type": "number"}}
    assert status["stream"]["properties"]["fps"] == {"type": "number"}
    assert status["refused"] == {"type": "object", "properties": {}}
    assert "waypoints" not in mission and "name" in mission
    assert detections["boxes"]["items"]["properties"]["label"] == {"type": "string"}


@given(jpeg=st.binary(max_size=200), pose=st.tuples(METERS, METERS, st.floats(-3.2, 3.2)))
@COMMON
def test_frame_is_an_image_and_a_pose(tmp_path_factory, jpeg, pose):
    header = encode(FrameHeader(**STAMP, pose=pose))
    read = shown(tmp_path_factory.mktemp("frame") / "run.mcap", Message(FRAME, "", header, jpeg))
    image, moved = read["foxglove.CompressedImage"], read["foxglove.FrameTransform"]
    assert base64.b64decode(image["data"]) == jpeg
    assert (image["format"], image["frame_id"], image["message_header"]["pose"]) == ("jpeg", "camera", list(pose))
    assert (moved["parent_frame_id"], moved["child_frame_id"]) == ("odometry", "base")
    assert moved["translation"] == {"x": pose[0], "y": pose[1], "z": 0.0}
    ahead = rotated(moved["rotation"], (1.0, 0.0, 0.0))
    assert ahead == pytest.approx([math.cos(pose[2]), math.sin(pose[2]), 0.0], abs=1e-9)


def rotated(turn: dict[str, float], vector) -> list[float]:
    """Rotate a vector by a quaternion: v + 2 u x (u x v + w v)."""
    axis = np.array([turn["x"], turn["y"], turn["z"]])
    assert axis @ axis + turn["w"] ** 2 == pytest.approx(1.0)
    return list(vector + 2 * np.cross(axis, np.cross(axis, vector) + turn["w"] * np.array(vector)))


@given(pitch_rad=st.floats(-1.5, 1.5), place=st.tuples(METERS, METERS, METERS),
       distortion=st.lists(st.floats(-1, 1), max_size=8))
@COMMON
def test_camera_model_is_a_calibration_and_a_mounting(tmp_path_factory, pitch_rad, place, distortion):
    model = CameraModel(
        width_px=320, height_px=240, fx_px=190.5, fy_px=191.5, cx_px=159.5, cy_px=119.5, distortion=tuple(distortion),
        x_m=place[0], y_m=place[1], z_m=place[2], pitch_rad=pitch_rad,
    )
    path = tmp_path_factory.mktemp("camera") / "run.mcap"
    read = shown(path, Message(CAMERA, "", encode(Stamp(**STAMP)), encode(model)))
    found, mounted = read["foxglove.CameraCalibration"], read["foxglove.FrameTransform"]
    assert (found["width"], found["height"], found["frame_id"]) == (320, 240, "camera")
    assert found["K"] == [190.5, 0, 159.5, 0, 191.5, 119.5, 0, 0, 1]
    assert found["R"] == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert found["P"] == [190.5, 0, 159.5, 0, 0, 191.5, 119.5, 0, 0, 0, 1, 0]
    lengths = {"plumb_bob": 5, "rational_polynomial": 8}
    assert len(found["D"]) == lengths[found["distortion_model"]] and found["D"][: len(distortion)] == distortion
    assert found["distortion_model"] == ("plumb_bob" if len(distortion) <= 5 else "rational_polynomial")
    assert not any(found["D"][len(distortion) :])
    assert (mounted["parent_frame_id"], mounted["child_frame_id"]) == ("base", "camera")
    assert mounted["translation"] == dict(zip("xyz", place, strict=True))
    # In the frame of the robot (x ahead, y left, z up): right, down and ahead of the image.
    up, ahead = math.sin(pitch_rad), math.cos(pitch_rad)
    assert rotated(mounted["rotation"], (1.0, 0.0, 0.0)) == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)
    assert rotated(mounted["rotation"], (0.0, 1.0, 0.0)) == pytest.approx([up, 0.0, -ahead], abs=1e-9)
    assert rotated(mounted["rotation"], (0.0, 0.0, 1.0)) == pytest.approx([ahead, 0.0, up], abs=1e-9)


@given(ranges_m=st.lists(st.floats(0, 100, width=32) | st.just(math.inf), max_size=20), step_rad=st.floats(-0.1, 0.1))
@COMMON
def test_scan_has_its_angles_and_rays_without_an_echo(tmp_path_factory, ranges_m, step_rad):
    header = encode(ScanHeader(**STAMP, angle_min_rad=-1.5, angle_increment_rad=step_rad, range_min_m=0.1,
                               range_max_m=8.0))
    payload = np.array(ranges_m, "<f4").tobytes()
    read = shown(tmp_path_factory.mktemp("scan") / "run.mcap", Message(SCAN, "", header, payload))
    found = read["foxglove.LaserScan"]
    assert found["ranges"] == ranges_m and found["intensities"] == [] and found["frame_id"] == "base"
    assert found["start_angle"] == -1.5
    assert found["end_angle"] == pytest.approx(-1.5 + step_rad * max(0, len(ranges_m) - 1))
    assert found["pose"] == {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}


def test_twist_has_its_numbers_also_without_a_header(path):
    for header in (b"", b'{"v":1}'):
        read = shown(path, Message(TWIST, "guest", header, b"0.2000|-0.3500"))["sightline.twist"]
        assert (read["linear_mps"], read["angular_rad_s"], read["data"]) == (0.2, -0.35, "0.2000|-0.3500")
        assert read.get("message_header") == (json.loads(header) if header else None)


SCAN_HEADER = encode(ScanHeader(**STAMP, angle_min_rad=0.0, angle_increment_rad=0.1, range_min_m=0.1, range_max_m=8.0))
DEEP = b"[" * 16_000 + b"]" * 16_000


@pytest.mark.parametrize("message", [
    Message(DETECTIONS, "vision", b"{}", DEEP), Message(STATUS, "", DEEP, b"{}"),
    Message(STATUS, "", b"null", b'{"a":NaN}'), Message(STATUS, "", b"{}", b"{}{}"),
    Message(STATUS, "", b'{},"data":{}', b"{}"), Message(STATUS, "", b"\xff", b"{}"), Message(STATUS, "", b"", b""),
    Message(TWIST, "vision", b"{}", b"nan|0"), Message(TWIST, "vision", b"{}", b"\xff"),
    Message(CAMERA, "", b"{}", b"{}"), Message(SCAN, "", b"{}", b""), Message(FRAME, "", b"{", b"jpeg"),
    Message(SCAN, "", SCAN_HEADER[:-1] + b',"x":"Infinity"}', b""), Message(STATUS, "", b" ", b"{}"),
])  # fmt: skip
def test_invalid_message_is_kept_without_a_schema(path, message):
    recorder = record(path, [message, message])
    assert recorder.failed == "" and [one.message for one in read_recording(path)] == [message, message]
    with path.open("rb") as file:
        assert {channel.message_encoding for _, channel, _ in make_reader(file).iter_messages()} == {ENCODING}


def test_older_recording_without_schemas_reads_the_same(path):
    messages = [message for message, _ in golden()]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for message in messages:
            topic = message.channel.name + ("/" + message.source if message.source else "")
            channel = writer.register_channel(topic, "sightline.v1", 0)
            data = len(message.header).to_bytes(2, "big") + message.header + message.payload
            writer.add_message(channel, 5, data, 5)
        writer.finish()
    assert [one.message for one in read_recording(path)] == messages


@pytest.mark.parametrize("channel", [TWIST, STATUS, FRAME])
def test_damaged_message_is_one_line(path, channel):
    good = foxglove.shown(Message(channel, "", b'{"v":1}', b"0|0" if channel is TWIST else b"[]"), 5)
    outcomes = set()
    for at in range(len(good)):
        for byte in (b"[", b"7", b'"', b"\xff", b""):
            with path.open("wb") as file:
                writer = Writer(file)
                writer.start()
                number = writer.register_channel(channel.name, "json", 0)
                writer.add_message(number, 5, good[:at] + byte + good[at + 1 :], 5)
                writer.finish()
            try:
                outcomes.add(len(list(read_recording(path))))
            except ConfigError as error:
                assert str(error).startswith(f"invalid recording {path}: ")
                outcomes.add("one line")
    assert outcomes == {1, "one line"}
