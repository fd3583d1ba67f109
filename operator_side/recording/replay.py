"""Replays a recording through a fresh pipeline; the twists must be the same, byte for byte. Shell (reads files).

Frames that were answered go in again in the order they were answered, one pipeline per vision session; with each go the
scan and the mission that its answer cites.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from sightline.operator_side.recording.recorder import read_about, read_recording
from sightline.protocol.channels import ACK, CAMERA, DETECTIONS, FRAME, MISSION, SCAN, TWIST
from sightline.protocol.codec import decode
from sightline.protocol.errors import ConfigError, WireError
from sightline.protocol.messages import (
    AnswerHeader,
    CameraModel,
    DetectionsHeader,
    FrameHeader,
    MissionRequest,
    RequestHeader,
    RequestId,
    Stamp,
)
from sightline.protocol.text import format_twist
from sightline.protocol.transports.link import Message
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.missions.ranges import decode_scan
from sightline.vision_side.missions.registry import requested_mission
from sightline.vision_side.pipeline import SOURCE, Frame, Pipeline, PipelineAnswer
from sightline.vision_side.tracking.locate import BoxReader

VISION_CONFIG = "vision_config"
"""Key of the recording's metadata that holds the configuration of vision, as JSON."""

_FrameId = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Step:
    """One answered frame: what was on the wire (None: an acknowledgement) and what the pipeline says now."""

    frame: Frame
    sent: bytes | None
    answer: PipelineAnswer

    @property
    def now(self) -> bytes | None:
        """What the pipeline would send."""
        return format_twist(self.answer.twist) if self.answer.twist is not None else None


@dataclass(slots=True)
class Replayed:
    """What a replay found. With answers lost on the way or frames not recorded, later twists may differ."""

    total: int = 0
    equal: int = 0
    missing_frames: int = 0
    gaps: int = 0
    """Answers that vision numbered, and scans and missions that they cite, which nobody recorded."""
    first_difference: str = ""

    @property
    def ok(self) -> bool:
        """Whether every answer was there and equal."""
        return 0 < self.total == self.equal and not self.missing_frames and not self.gaps


@dataclass(slots=True)
class _Answers:
    """Answers of the recording, by the frame they cite; and what else they cite: scans, missions."""

    by_frame: dict[_FrameId, list[tuple[AnswerHeader, bytes | None]]] = field(default_factory=dict)
    gaps: int = 0
    scans: dict[_FrameId, Message] = field(default_factory=dict)
    missions: dict[RequestId, MissionRequest] = field(default_factory=dict)
    boxes: dict[_FrameId, Message] = field(default_factory=dict)
    """What somebody else found in each frame, for a vision without eyes of its own."""


def replay(path: Path, on_step: Callable[[Step], None] = lambda _step: None) -> Replayed:
    """Replay the recording at `path`; `on_step` is told each answered frame. Raises ConfigError if it is none."""
    answers = _answers(path)
    missing = _gather_cited(path, answers)
    result = Replayed(gaps=answers.gaps + missing)
    for step in _steps(path, answers):
        on_step(step)
        result.total += 1
        result.equal += step.sent == step.now
        if step.sent != step.now and not result.first_difference:
            result.first_difference = f"frame {step.frame.header.seq}: sent {step.sent!r}, now {step.now!r}"
    result.missing_frames = sum(len(some) for some in answers.by_frame.values())
    return result


def replay_steps(path: Path) -> Iterator[Step]:
    """Every answered frame with its answer, in order. Raises ConfigError if `path` is no recording."""
    answers = _answers(path)
    _gather_cited(path, answers)
    return _steps(path, answers)


def _newest_camera(message: Message, camera: CameraModel, pipelines: Iterable[Pipeline]) -> CameraModel:
    """The model in `message`; if it is another one, the pipelines continue with it."""
    model = decode(CameraModel, message.payload, CAMERA.max_payload_bytes)
    for pipeline in pipelines if model != camera else ():
        pipeline.set_camera(model)
    return model


def _steps(path: Path, answers: _Answers) -> Iterator[Step]:
    """Takes out of `answers` what it uses; what is left cites frames that were not recorded."""
    config = _vision_config(path)
    camera, detector = _first_camera(path), configured_detector(config)
    pipelines: dict[str, Pipeline] = {}
    for recorded in read_recording(path):
        message = recorded.message
        if message.channel is CAMERA:
            camera = _newest_camera(message, camera, pipelines.values())
        if message.channel is not FRAME:
            continue
        frame = Frame(decode(FrameHeader, message.header), message.payload)
        for header, sent in answers.by_frame.pop((frame.header.session, frame.header.seq), ()):
            if sent is None and header.session not in pipelines:
                continue  # before its first twist vision may not have had the camera's model: it only acknowledged
            if header.session not in pipelines:
                pipelines[header.session] = Pipeline(config, camera, detector)
            pipeline = pipelines[header.session]
            _give(pipeline, header, answers, config)
            if config.detector.kind == "boxes":
                found = answers.boxes.get((frame.header.session, frame.header.seq))
                if sent is not None and found is not None:  # what only acknowledges tells that the frame arrived
                    yield Step(frame, sent, _by_boxes(pipeline, frame, found, camera, config))
            else:
                yield Step(frame, sent, pipeline.step(frame))


def _by_boxes(
    pipeline: Pipeline, frame: Frame, found: Message, camera: CameraModel, config: VisionConfig
) -> PipelineAnswer:
    """What the pipeline answers to what somebody else found in `frame`."""
    reader = BoxReader(config.boxes)
    reader.remember(frame.header)
    return pipeline.follow(*reader.read(found.header, found.payload, camera))


def _give(pipeline: Pipeline, header: AnswerHeader, answers: _Answers, config: VisionConfig) -> None:
    """What the answer of `header` went by besides its frame, if that is in the recording."""
    scan = answers.scans.get((header.echo.session, header.scan)) if header.scan is not None else None
    if scan is not None:
        pipeline.put_scan(*decode_scan(scan.header, scan.payload))
    request = answers.missions.get(header.mission) if header.mission else None
    if header.mission and request:
        pipeline.switch(requested_mission(request, config), header.mission, header.echo.session)


def _gather_cited(path: Path, answers: _Answers) -> int:
    """Fill in the scans and missions that answers cite; returns how many are not in the recording."""
    headers = [header for some in answers.by_frame.values() for header, _ in some]
    scans = {(one.echo.session, one.scan) for one in headers if one.scan is not None}
    missions = {one.mission for one in headers if one.mission is not None}
    for recorded in read_recording(path):
        message = recorded.message
        if message.channel is DETECTIONS:
            echo = decode(DetectionsHeader, message.header).echo
            if echo is not None:
                answers.boxes[echo.session, echo.seq] = message
        if message.channel is SCAN:
            stamp = decode(Stamp, message.header)
            if (stamp.session, stamp.seq) in scans:
                answers.scans[stamp.session, stamp.seq] = message
        elif message.channel is MISSION:
            request = decode(MissionRequest, message.payload, MISSION.max_payload_bytes)
            asked = RequestId(session=decode(RequestHeader, message.header).session, id=request.id)
            answers.missions.setdefault(asked, request)
    return len(scans - set(answers.scans)) + len(missions - set(answers.missions))


def _answers(path: Path) -> _Answers:
    answers = _Answers()
    last: dict[str, int] = {}
    for recorded in read_recording(path):
        header = _answer_header(recorded.message)
        if header is None:
            continue
        answers.gaps += max(0, header.seq - last.get(header.session, header.seq - 1) - 1)
        last[header.session] = header.seq
        twist = recorded.message.payload if recorded.message.channel is TWIST else None
        answers.by_frame.setdefault((header.echo.session, header.echo.seq), []).append((header, twist))
    return answers


def _answer_header(message: Message) -> AnswerHeader | None:
    """The header of an answer of vision to a frame; None for everything else."""
    if message.channel not in (TWIST, ACK) or message.source != SOURCE:
        return None
    try:
        header = decode(AnswerHeader, message.header)
    except WireError:
        return None
    return header if header.echo.channel == "frame" else None


def _vision_config(path: Path) -> VisionConfig:
    text = read_about(path).get(VISION_CONFIG)
    if text is None:
        raise ConfigError(f"{path} does not say how vision was configured, so it cannot be replayed")
    return VisionConfig.model_validate_json(text)


def _first_camera(path: Path) -> CameraModel:
    for recorded in read_recording(path):
        if recorded.message.channel is CAMERA:
            return decode(CameraModel, recorded.message.payload, CAMERA.max_payload_bytes)
    raise ConfigError(f"{path} holds no camera model")
