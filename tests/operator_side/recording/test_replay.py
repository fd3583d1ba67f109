"""Scans and missions of a vision service return from a recording, byte for byte."""

from types import SimpleNamespace

import pytest

from sightline.evaluation.lockstep import Conditions, Lockstep
from sightline.evaluation.scenario_config import robot_config, vision_config
from sightline.operator_side.recording.recorder import Recorder, read_about, read_recording
from sightline.operator_side.recording.replay import VISION_CONFIG, replay, replay_steps
from sightline.protocol.channels import CAMERA, MISSION, SCAN, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, Stamp
from sightline.sim.robot import load_robot
from sightline.sim.scenario import load_scenario
from sightline.sim.world.world import World
from sightline.vision_side.config import DetectorConfig, MissionConfig
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.port import NO_DEADLINE
from sightline.vision_side.serving import service
from tests.fixtures.vision.vision import camera, jpeg_of, scene
from tests.operator_side.recording.test_recorder import record
from tests.vision_side.serving.test_mission_channel import FRAME_US, GOTO, MODEL, Bench, scan

pytestmark = pytest.mark.computes


def scanned(bench, count):
    """Frames with a scan before every third, as a robot sends them."""
    for at in range(count):
        if at % 3 == 0:
            bench.robot.publish(SCAN, *scan(bench.seq, t_us=bench.seq * FRAME_US))
        bench.frames()


def show_camera(bench, model):
    bench.robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=2, t_us=bench.seq * FRAME_US)), encode(model))
    bench.turn()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """On a busy machine no detection is late: a replay has no deadline."""
    path = tmp_path_factory.mktemp("missions") / "run.mcap"
    config = GOTO.model_copy(update={"detector": GOTO.detector.model_copy(update={"deadline_s": 1.0})})
    bench = Bench(config=config)
    with Recorder(bench.network.link("r1"), path, {VISION_CONFIG: config.model_dump_json()}):
        show_camera(bench, MODEL)
        scanned(bench, 20)
        bench.ask("band", 1, options={"averaged": 2})
        scanned(bench, 12)
        bench.ask("bnad", 2).frames(2)
        bench.ask("follow", 3)
        scanned(bench, 6)
        bench.image = jpeg_of(scene(MODEL, 1.1, 0.1, shaded=True))
        scanned(bench, 6)
        bench.ask("goto", 4, waypoints=((0.5, 1.0), (0.0, 0.0)))
        scanned(bench, 12)
        show_camera(bench, camera(pitch_rad=0.1))
        scanned(bench, 6)
        bench.frames(6, session="0000beef")
    return path


def answers(path):
    return [decode(AnswerHeader, one.message.header) for one in read_recording(path) if one.message.channel is TWIST]


def test_replay_repeats_scans_and_switched_missions_byte_for_byte(recorded):
    headers = answers(recorded)
    assert [{one.mission.id for one in headers if one.mission} == {1, 3, 4}, headers[-1].mission] == [True, None]
    assert len({one.scan for one in headers if one.scan is not None}) > 10
    result = replay(recorded)
    assert result.ok and result.total == len(headers) > 60, result
    assert len({step.now for step in replay_steps(recorded)}) > 5, "it did different things"


@pytest.mark.parametrize("channel", [SCAN, MISSION])
def test_replay_reports_an_input_that_was_not_recorded(recorded, tmp_path, channel):
    kept = [one.message for one in read_recording(recorded) if one.message.channel is not channel]
    record(tmp_path / "run.mcap", kept, **read_about(recorded))
    result = replay(tmp_path / "run.mcap")
    assert not result.ok and result.gaps > 0


def test_mission_with_scans_is_repeated_exactly(tmp_path):
    scenario, model = load_scenario("circle"), load_robot("raspberry")
    mission = MissionConfig(kind="goto", options={"waypoints": [[0.6, -0.4], [0.0, 0.0]]})
    config = vision_config(scenario, model).model_copy(update={"mission": mission})
    path = tmp_path / "run.mcap"
    with World(scenario, model, 5) as world:
        lockstep = Lockstep(world, robot_config(model, auto_arm=True), config, Conditions(latency_ms=30), 5)
        with Recorder(lockstep.network.link("r1"), path, {VISION_CONFIG: config.model_dump_json()}):
            lockstep.network.link("r1").publish(CAMERA, encode(Stamp(session="00000001", seq=0, t_us=0)),
                                                encode(world.camera_model))
            while world.now_us < 4_000_000:
                lockstep.step()
    scans = [one.scan for one in answers(path) if one.scan is not None]
    assert len(set(scans)) > 25 and scans == sorted(scans)
    result = replay(path)
    assert result.ok and result.total > 60, result


class Remote(Hsv):
    """A detector that waits for another service, which is sometimes late. It is never late in a replay."""

    waits = True
    late = 0

    def detect(self, frames, deadline_us):
        Remote.late = max(0, Remote.late - 1)
        return [None] * len(frames) if Remote.late else super().detect(frames, deadline_us)


@pytest.mark.parametrize("fallback", ["", "hsv"])
def test_replay_shows_that_a_fallback_may_have_answered(tmp_path, fallback):
    detector = DetectorConfig(kind="hsv", fallback=fallback, deadline_s=1.0)
    path, config = tmp_path / "run.mcap", GOTO.model_copy(update={"detector": detector, "mission": MissionConfig()})
    bench = Bench(config=GOTO)
    with Recorder(bench.network.link("r1"), path, {VISION_CONFIG: config.model_dump_json()}):
        show_camera(bench, MODEL)
    assert replay(path).has_fallback is bool(fallback)


@pytest.mark.parametrize("late", [1, 2, 7])
def test_frame_of_a_late_remote_detector_is_acknowledged_again(monkeypatch, tmp_path, late):
    detector = DetectorConfig(kind=f"{__name__}:Remote", deadline_s=1.0)
    path, config = tmp_path / "run.mcap", GOTO.model_copy(update={"detector": detector, "mission": MissionConfig()})
    bench = Bench(config=config)
    bench.image = jpeg_of(scene(MODEL, 1.1, 0.1, shaded=True))
    with Recorder(bench.network.link("r1"), path, {VISION_CONFIG: config.model_dump_json()}):
        show_camera(bench, MODEL)
        bench.frames(5)
        monkeypatch.setattr(Remote, "late", late + 1)
        bench.frames(late + 5)
    steps = list(replay_steps(path))
    assert [step.sent is None for step in steps] == [*[False] * 5, *[True] * late, *[False] * 5]
    assert replay(path).ok and {step.answer.skipped for step in steps} == {"", "NO_ANSWER"}


class Local(Hsv):
    """A detector of this process. When it begins after the deadline, it gives no answer."""

    took_s = 0.0
    spent_s = 0.0

    def detect(self, frames, deadline_us):
        Local.spent_s += Local.took_s
        is_late = Local.took_s > 0 and deadline_us != NO_DEADLINE
        return [None] * len(frames) if is_late else super().detect(frames, deadline_us)


@pytest.mark.parametrize("took_s", [0.01, 0.099, 0.1, 0.3])
def test_only_a_frame_after_its_deadline_is_not_examined_again(monkeypatch, tmp_path, took_s):
    """Each other answer is compared, so that a detector that gives another answer each time is found."""
    detector = DetectorConfig(kind=f"{__name__}:Local", deadline_s=0.1)
    path, config = tmp_path / "run.mcap", GOTO.model_copy(update={"detector": detector, "mission": MissionConfig()})
    spent = {"perf_counter_ns": lambda: round(Local.spent_s * 1e9)}
    monkeypatch.setattr(service, "time", SimpleNamespace(**vars(service.time) | spent))
    bench = Bench(config=config)
    bench.image = jpeg_of(scene(MODEL, 1.1, 0.1, shaded=True))
    with Recorder(bench.network.link("r1"), path, {VISION_CONFIG: config.model_dump_json()}):
        show_camera(bench, MODEL)
        bench.frames(5)
        monkeypatch.setattr(Local, "took_s", took_s)
        bench.frames(2)
        monkeypatch.setattr(Local, "took_s", 0.0)
        bench.frames(5)
    assert [step.sent is None for step in replay_steps(path)] == [*[False] * 5, *[True] * 2, *[False] * 5]
    assert replay(path).ok is (took_s >= detector.deadline_s)


def test_twist_that_was_sent_twice_is_computed_once(tmp_path):
    """After lost frames the vision service sends each twist twice."""
    path, bench = tmp_path / "run.mcap", Bench(config=GOTO)
    with Recorder(bench.network.link("r1"), path, {VISION_CONFIG: GOTO.model_dump_json()}):
        show_camera(bench, MODEL)
        bench.frames(3)
        bench.seq += 10
        bench.frames(4)
    assert len(answers(path)) == 3 + 2 * 4
    result = replay(path)
    assert result.ok and result.total == 7 and not result.missing_frames, result
