"""Recording and replay: the messages of a link return, and the pipeline answers the same, byte for byte."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.evaluation.lockstep import Conditions, Lockstep
from sightline.evaluation.scenario_config import robot_config, vision_config
from sightline.operator_side.recording.recorder import (
    CHUNK_BYTES,
    MAX_WAITING,
    RECORDED,
    Recorder,
    read_about,
    read_recording,
)
from sightline.operator_side.recording.replay import VISION_CONFIG, replay, replay_steps
from sightline.protocol.channels import CAMERA, CHANNELS, FRAME, STATUS, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import Stamp
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.sim.robot import load_robot
from sightline.sim.scenario import load_scenario
from sightline.sim.world.world import World

MESSAGES = st.builds(
    lambda channel, header, payload: Message(channel, "vision" if channel.has_source else "", header, payload),
    st.sampled_from(list(CHANNELS.values())), st.binary(max_size=512), st.binary(max_size=64),
).filter(lambda message: len(message.payload) <= message.channel.max_payload_bytes)


class Wire:
    """A link that delivers each given message to its subscribers immediately."""

    def __init__(self) -> None:
        self.callbacks = {}

    def subscribe(self, channel, callback) -> None:
        self.callbacks[channel.name] = callback

    def deliver(self, message: Message) -> None:
        self.callbacks[message.channel.name](message)


def record(path: Path, messages, **about: str) -> Recorder:
    wire = Wire()
    with Recorder(wire, path, about, CHANNELS.values()) as recorder:
        for message in messages:
            wire.deliver(message)
    return recorder


@settings(max_examples=40)
@given(st.lists(MESSAGES, max_size=30))
def test_recording_returns_all_messages_in_order(tmp_path_factory, messages):
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    recorder = record(path, messages, scenario="circle")
    assert [one.message for one in read_recording(path)] == messages
    assert read_about(path) == {"scenario": "circle"}
    assert sum(recorder.counts.values()) == len(messages)


def test_a_recording_cut_short_reads_up_to_the_cut(tmp_path):
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    messages = [Message(FRAME, "", b"%d" % at, bytes(CHUNK_BYTES // 8)) for at in range(100)]
    record(whole, messages)
    data = whole.read_bytes()
    lengths = set()
    for share in range(0, 100, 7):
        cut.write_bytes(data[: len(data) * share // 100])
        read = [one.message for one in read_recording(cut)]
        assert read == messages[: len(read)]
        lengths.add(len(read))
    assert len(lengths) > 5, "the cut must have been in different places"


def test_recording_cut_at_any_byte_reads_up_to_the_cut(tmp_path):
    path = tmp_path / "run.mcap"
    messages = [Message(FRAME, "", b"%d" % at, b"jpeg") for at in range(3)]
    record(path, messages, scenario="Übung")
    counts = set()
    for length in reversed(range(path.stat().st_size)):
        os.truncate(path, length)
        read = [one.message for one in read_recording(path)]
        assert read == messages[: len(read)]
        counts.add(len(read))
        try:
            assert read_about(path) == {"scenario": "Übung"}
        except ConfigError:
            assert not read
    assert counts == {0, 3}


def test_step_of_the_wall_clock_moves_no_message(tmp_path, monkeypatch):
    steps_s = iter([0, -3600, 7200, -1])
    now_ns = time.time_ns()
    monkeypatch.setattr("time.time_ns", lambda: now_ns + next(steps_s) * 10**9)
    record(tmp_path / "run.mcap", [Message(FRAME, "", b"%d" % at, b"") for at in range(9)])
    times_ns = [one.log_time_ns for one in read_recording(tmp_path / "run.mcap")]
    assert len(times_ns) == 9 and times_ns == sorted(times_ns)
    assert now_ns <= times_ns[0] and times_ns[-1] < now_ns + 60 * 10**9


def test_recording_with_a_damaged_byte_reads_or_is_one_line(tmp_path):
    path = tmp_path / "run.mcap"
    record(path, [Message(FRAME, "", b"%d" % at, b"jpeg") for at in range(2)], scenario="circle")
    content, outcomes = path.read_bytes(), set()
    for at in range(len(content)):
        path.write_bytes(content[:at] + bytes([content[at] ^ 0x80]) + content[at + 1 :])
        try:
            outcomes.add(len(list(read_recording(path))))
        except ConfigError as error:
            outcomes.add(str(error).partition(" /")[0])
    assert {2, "invalid recording"} <= outcomes <= {0, 1, 2, "invalid recording"}


def test_a_slow_disk_drops_and_counts_and_never_blocks_the_link(tmp_path):
    wire, gate = Wire(), threading.Event()
    recorder = Recorder(wire, tmp_path / "run.mcap", {}, [FRAME])
    write = recorder._write
    recorder._write = lambda *item: (gate.wait(10), write(*item))
    sent = MAX_WAITING + 100
    for at in range(sent):
        wire.deliver(Message(FRAME, "", b"%d" % at, b""))
    gate.set()
    recorder.close()
    kept = sum(1 for _ in read_recording(tmp_path / "run.mcap"))
    assert kept + recorder.dropped == sent
    assert recorder.dropped >= 99


def test_other_file_than_a_recording_is_rejected(tmp_path):
    with pytest.raises(ConfigError, match="nothing here"):
        list(read_recording(tmp_path / "nothing here"))
    (tmp_path / "text").write_text("hello, this is a text and no recording at all")
    damaged = r"^invalid recording .*text: damaged, or another type of file \(InvalidMagic\); choose a run\.mcap$"
    with pytest.raises(ConfigError, match=damaged):
        read_about(tmp_path / "text")


# --- replay ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Two seconds of the real line in virtual time, recorded from its network."""
    path = tmp_path_factory.mktemp("replay") / "run.mcap"
    scenario = load_scenario("circle")
    model = load_robot("raspberry")
    config = vision_config(scenario, model)
    with World(scenario, load_robot("raspberry"), 7) as world:
        lockstep = Lockstep(world, robot_config(model, auto_arm=True), config, Conditions(latency_ms=20), 7)
        link, camera = lockstep.network.link("r1"), lockstep.network.link("r1")
        with Recorder(link, path, {VISION_CONFIG: config.model_dump_json()}):
            stamp = Stamp(session="00000001", seq=0, t_us=0)
            camera.publish(CAMERA, encode(stamp), encode(world.camera_model))
            while world.now_us < 2_000_000:
                lockstep.step()
    return path


def rewritten(recorded: Path, path: Path, change) -> Path:
    """A copy with each message changed, or left out where `change` gives None."""
    messages = [change(at, one.message) for at, one in enumerate(read_recording(recorded))]
    record(path, [message for message in messages if message is not None], **read_about(recorded))
    return path


def test_replay_gives_the_twists_that_were_sent(recorded):
    result = replay(recorded)
    assert result.ok
    assert result.total > 45
    assert any(step.sent not in (None, b"0.0000|0.0000") for step in replay_steps(recorded))


def test_replay_names_the_first_difference(recorded, tmp_path):
    twists = [at for at, one in enumerate(read_recording(recorded)) if one.message.channel is TWIST]

    def change(at: int, message: Message) -> Message:
        if at in twists[10:12]:
            return Message(TWIST, message.source, message.header, b"0.1234|0.0000")
        return message

    result = replay(rewritten(recorded, tmp_path / "run.mcap", change))
    assert not result.ok
    assert result.total - result.equal == 2
    assert "0.1234|0.0000" in result.first_difference


@pytest.mark.parametrize(("channel", "missing_frames", "gaps"), [(FRAME, 1, 0), (TWIST, 0, 1)])
def test_replay_reports_missing_messages(recorded, tmp_path, channel, missing_frames, gaps):
    channels = [one.message.channel for one in read_recording(recorded)]
    sixth = [at for at, one in enumerate(channels) if one is channel][5]
    result = replay(rewritten(recorded, tmp_path / "run.mcap", lambda at, one: None if at == sixth else one))
    assert (result.missing_frames, result.gaps, result.ok) == (missing_frames, gaps, False)
    assert result.total == channels.count(TWIST) - 1


@pytest.mark.parametrize("channel", RECORDED)
@pytest.mark.parametrize("is_of_header", [True, False])
def test_replay_ignores_an_invalid_message_as_the_services_did(recorded, tmp_path, channel, is_of_header):
    messages = [one.message for one in read_recording(recorded)]
    tenth = [at for at, one in enumerate(messages) if one.channel is TWIST][9]
    header = encode(Stamp(session="0000000b", seq=1, t_us=1))
    bad = Message(channel, "vision" if channel.has_source else "", b"{" if is_of_header else header, b"{")
    record(tmp_path / "run.mcap", [bad, *messages[:20], bad, *messages[20 : tenth + 1], bad], **read_about(recorded))
    result = replay(tmp_path / "run.mcap")
    assert result.ok and result.total == 10


@pytest.mark.parametrize("config", ["{", '{"an_option_of_a_later_version": 1}'])
def test_recording_of_another_version_is_one_line(recorded, tmp_path, config):
    messages = [one.message for one in read_recording(recorded)]
    record(tmp_path / "run.mcap", messages, **{VISION_CONFIG: config})
    with pytest.raises(ConfigError, match=r"run\.mcap has a configuration of another version; record it again"):
        replay(tmp_path / "run.mcap")
    later = [Message(one.channel, one.source, one.header.replace(b'"v":1', b'"v":2'), one.payload) for one in messages]
    record(tmp_path / "later.mcap", later, **read_about(recorded))
    with pytest.raises(ConfigError, match=r"later\.mcap has no camera model; record it again"):
        replay(tmp_path / "later.mcap")


def test_replay_needs_the_configuration_of_vision(recorded, tmp_path):
    record(tmp_path / "run.mcap", [one.message for one in read_recording(recorded)], other="thing")
    with pytest.raises(ConfigError, match=r"lacks the configuration of .* service; replay one of `sightline demo`"):
        replay(tmp_path / "run.mcap")


def test_recording_takes_nothing_from_the_network_it_listens_to(tmp_path):
    network = MemoryNetwork()
    robot, heard = network.link("r1"), []
    network.link("r1").subscribe(STATUS, heard.append)
    with Recorder(network.link("r1"), tmp_path / "run.mcap", {}):
        robot.publish(STATUS, b"{}", b"{}")
        network.advance(1)
    assert len(heard) == 1
    assert [one.message for one in read_recording(tmp_path / "run.mcap")] == heard


def test_a_disk_that_is_full_ends_the_recording_with_one_line(caplog, capfd):
    """No thread dies, `close` comes back, and why it ends early is kept."""
    wire = Wire()
    with Recorder(wire, Path("/dev/full"), {}, CHANNELS.values()) as recorder:
        for at in range(3 * MAX_WAITING):
            wire.deliver(Message(FRAME, "", b"%d" % at, bytes(CHUNK_BYTES // 4)))
            time.sleep(0.0005)
    assert caplog.messages == ["recording /dev/full: No space left on device; the recording ends"]
    assert recorder.failed == "No space left on device" and capfd.readouterr().err == ""


_HANGS = """
import sys, time
from pathlib import Path
from sightline.operator_side.recording import recorder
from sightline.protocol.channels import FRAME
from sightline.protocol.transports.link import Message
recorder.CLOSE_S = 0.2
recorder.RecordingFile.write = lambda *_: time.sleep(60)
class Wire:
    def subscribe(self, channel, callback):
        self.deliver = callback
wire = Wire()
recording = recorder.Recorder(wire, Path(sys.argv[1]), {}, [FRAME])
for _ in range(2 * recorder.MAX_WAITING):
    wire.deliver(Message(FRAME, "", b"", bytes(recorder.CHUNK_BYTES // 4)))
recording.close()
print(recording.failed)
"""


def test_a_disk_that_hangs_ends_neither_close_nor_the_exit(tmp_path):
    """The place for waiting messages is full, and the thread that writes never returns."""
    command = [sys.executable, "-c", _HANGS, str(tmp_path / "run.mcap")]
    run = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    assert (run.returncode, run.stdout) == (0, "the disk does not respond for 0.2 s\n"), run.stderr


def test_an_error_of_the_file_format_ends_the_recording_and_close_comes_back(tmp_path, caplog):
    wire = Wire()
    recorder = Recorder(wire, tmp_path / "run.mcap", {}, [FRAME])
    recorder._writer.add_message = lambda *_, **__: 1 / 0
    for _ in range(2 * MAX_WAITING):
        wire.deliver(Message(FRAME, "", b"", b""))
    closing = threading.Thread(target=recorder.close, daemon=True)
    closing.start()
    closing.join(5)
    assert not closing.is_alive()
    assert recorder.failed == "ZeroDivisionError: division by zero"
    assert [one.levelname for one in caplog.records] == ["ERROR", "WARNING"] and caplog.records[0].exc_info
