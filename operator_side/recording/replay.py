"""Replays a recording through a new pipeline. The twists must be equal, byte for byte. Shell (reads files).

It processes the answered frames in the order of their answers, with one pipeline per session of the vision service, and
with the scan and the mission that each answer cites.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

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
from sightline.vision_side.detect.registry import configured_detector, waits_for_service
from sightline.vision_side.missions.ranges import decode_scan
from sightline.vision_side.missions.registry import requested_mission
from sightline.vision_side.pipeline import NO_ANSWER, SOURCE, Frame, Observation, Pipeline, PipelineAnswer
from sightline.vision_side.tracking.locate import BoxReader

VISION_CONFIG = "vision_config"
"""Metadata key of the vision configuration, as JSON."""

_NO_ANSWER = Observation("no answer")

_FrameId = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Step:
    """One answered frame: the recorded answer (None: an acknowledgment) and the new answer of the pipeline."""

    frame: Frame
    sent: bytes | None
    answer: PipelineAnswer

    @property
    def now(self) -> bytes | None:
        """Return the payload of the pipeline's new answer."""
        return format_twist(self.answer.twist) if self.answer.twist is not None else None


@dataclass(slots=True)
class Replayed:
    """The result of a replay. After a lost answer or an unrecorded frame, later twists may differ."""

    total: int = 0
    equal: int = 0
    missing_frames: int = 0
    gaps: int = 0
    """Number of answers, and of cited scans and missions, that are not in the recording."""
    first_difference: str = ""
    has_fallback: bool = False
    """True if a fallback answered what came late. The same frame may be in time now, or late."""

    @property
    def ok(self) -> bool:
        """Return True if every answer is recorded and equal."""
        return 0 < self.total == self.equal and not self.missing_frames and not self.gaps


@dataclass(slots=True)
class _Answers:
    """The recorded answers by the cited frame, with the cited scans and missions."""

    by_frame: dict[_FrameId, list[tuple[AnswerHeader, bytes | None]]] = field(default_factory=dict)
    gaps: int = 0
    scans: dict[_FrameId, Message] = field(default_factory=dict)
    missions: dict[RequestId, MissionRequest] = field(default_factory=dict)
    boxes: dict[_FrameId, Message] = field(default_factory=dict)
    """Detections of another publisher in each frame, for a vision service without a detector."""


def replay(path: Path, on_step: Callable[[Step], None] = lambda _step: None) -> Replayed:
    """Replay the recording at `path`; call `on_step` for each answered frame. Raises ConfigError for another file."""
    answers = _answers(path)
    missing = _gather_cited(path, answers)
    result = Replayed(gaps=answers.gaps + missing, has_fallback=bool(_vision_config(path).detector.fallback))
    for step in _steps(path, answers):
        on_step(step)
        result.total += 1
        result.equal += step.sent == step.now
        if step.sent != step.now and not result.first_difference:
            result.first_difference = f"frame {step.frame.header.seq}: sent {_text(step.sent)}, now {_text(step.now)}"
    result.missing_frames = sum(len(some) for some in answers.by_frame.values())
    return result


def replay_steps(path: Path) -> Iterator[Step]:
    """Yield every answered frame with its answer, in order. Raises ConfigError if `path` is not a recording."""
    answers = _answers(path)
    _gather_cited(path, answers)
    return _steps(path, answers)


def recorded_frames(path: Path) -> Iterator[Frame]:
    """Yield every frame, answered or not, in order. Raises ConfigError if `path` is not a recording."""
    for message in _messages(path):
        if message.channel is FRAME:
            yield Frame(decode(FrameHeader, message.header), message.payload)


def _messages(path: Path) -> Iterator[Message]:
    """Yield the valid messages. The services ignored the others, too."""
    for recorded in read_recording(path):
        with suppress(WireError):
            _check(recorded.message)
            yield recorded.message


def _check(message: Message) -> None:
    channel = message.channel
    decode(channel.header, message.header)
    if channel is SCAN:
        decode_scan(message.header, message.payload)
    elif channel.payload is not None:
        decode(channel.payload, message.payload, channel.max_payload_bytes)


def _newest_camera(message: Message, camera: CameraModel, pipelines: Iterable[Pipeline]) -> CameraModel:
    """Return the camera model in `message`. The pipelines continue with a new model."""
    model = decode(CameraModel, message.payload, CAMERA.max_payload_bytes)
    for pipeline in pipelines if model != camera else ():
        pipeline.set_camera(model)
    return model


def _steps(path: Path, answers: _Answers) -> Iterator[Step]:
    """Yield the steps, and remove each used answer from `answers`. The rest cite frames outside the recording."""
    config = _vision_config(path)
    camera, detector = _first_camera(path), configured_detector(config)
    pipelines: dict[str, Pipeline] = {}
    for message in _messages(path):
        if message.channel is CAMERA:
            camera = _newest_camera(message, camera, pipelines.values())
        if message.channel is not FRAME:
            continue
        frame = Frame(decode(FrameHeader, message.header), message.payload)
        for header, sent in answers.by_frame.pop((frame.header.session, frame.header.seq), ()):
            if sent is None and header.session not in pipelines:
                continue  # before its first twist the vision service may lack the camera model: it only acknowledged
            if header.session not in pipelines:
                pipelines[header.session] = Pipeline(config, camera, detector)
            pipeline = pipelines[header.session]
            _give(pipeline, header, answers, config)
            if sent is None and _may_be_late(header, config):  # and now it may be in time
                yield Step(frame, None, pipeline.acknowledge(_NO_ANSWER, NO_ANSWER))
            elif config.detector.kind == "boxes":
                found = answers.boxes.get((frame.header.session, frame.header.seq))
                if sent is not None and found is not None:  # an acknowledgment shows that the frame arrived
                    yield Step(frame, sent, _by_boxes(pipeline, frame, found, camera, config))
            else:
                yield Step(frame, sent, pipeline.step(frame))


def _may_be_late(header: AnswerHeader, config: VisionConfig) -> bool:
    """Return True if the detector may have missed its deadline; a local one begins no frame after it."""
    return header.compute_us >= config.detector.deadline_s * 1e6 or waits_for_service(config)


def _by_boxes(
    pipeline: Pipeline, frame: Frame, found: Message, camera: CameraModel, config: VisionConfig
) -> PipelineAnswer:
    """Return the answer of the pipeline to another publisher's detections in `frame`."""
    reader = BoxReader(config.boxes)
    reader.remember(frame.header)
    return pipeline.follow(*reader.read(found.header, found.payload, camera))


def _give(pipeline: Pipeline, header: AnswerHeader, answers: _Answers, config: VisionConfig) -> None:
    """Pass the scan and mission that the answer cites to the pipeline, if they are in the recording."""
    scan = answers.scans.get((header.echo.session, header.scan)) if header.scan is not None else None
    if scan is not None:
        pipeline.put_scan(*decode_scan(scan.header, scan.payload))
    request = answers.missions.get(header.mission) if header.mission else None
    if header.mission and request:
        pipeline.switch(requested_mission(request, config), header.mission, header.echo.session)


def _gather_cited(path: Path, answers: _Answers) -> int:
    """Add the cited scans and missions. Returns the number of those that are not in the recording."""
    headers = [header for some in answers.by_frame.values() for header, _ in some]
    scans = {(one.echo.session, one.scan) for one in headers if one.scan is not None}
    missions = {one.mission for one in headers if one.mission is not None}
    for message in _messages(path):
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
            requested = RequestId(digest=decode(RequestHeader, message.header).digest, id=request.id)
            answers.missions.setdefault(requested, request)
    return len(scans - set(answers.scans)) + len(missions - set(answers.missions))


def _answers(path: Path) -> _Answers:
    answers = _Answers()
    last: dict[str, int] = {}
    for message in _messages(path):
        header = _answer_header(message)
        if header is None:
            continue
        answers.gaps += max(0, header.seq - last.get(header.session, header.seq - 1) - 1)
        last[header.session] = header.seq
        twist = message.payload if message.channel is TWIST else None
        of_frame = answers.by_frame.setdefault((header.echo.session, header.echo.seq), [])
        # On a lossy link a twist is sent twice. The pipeline computed it once.
        if twist is None or not any((one.session, sent) == (header.session, twist) for one, sent in of_frame):
            of_frame.append((header, twist))
    return answers


def _answer_header(message: Message) -> AnswerHeader | None:
    """Return the header of a vision service's answer to a frame; None for another message."""
    if message.channel not in (TWIST, ACK) or message.source != SOURCE:
        return None
    header = decode(AnswerHeader, message.header)
    return header if header.echo.channel == "frame" else None


def _vision_config(path: Path) -> VisionConfig:
    text = read_about(path).get(VISION_CONFIG)
    if text is None:
        raise ConfigError(f"{path} lacks the configuration of the vision service; replay one of `sightline demo`")
    try:
        return VisionConfig.model_validate_json(text)
    except ValidationError:
        raise ConfigError(f"{path} has a configuration of another version; record it again") from None


def _first_camera(path: Path) -> CameraModel:
    for message in _messages(path):
        if message.channel is CAMERA:
            return decode(CameraModel, message.payload, CAMERA.max_payload_bytes)
    raise ConfigError(f"{path} has no camera model; record it again")


def _text(payload: bytes | None) -> str:
    return "an acknowledgment" if payload is None else payload.decode("ascii", "replace")
