"""A recording through a fresh pipeline: the same frames must give the same twists, byte for byte. Shell.

Frames that were answered go in again in the order they were answered, one pipeline per vision session and camera model.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from operator_side.recording import read_about, read_recording
from protocol.channels import ACK, CAMERA, FRAME, TWIST
from protocol.codec import decode
from protocol.errors import ConfigError, WireError
from protocol.messages import AnswerHeader, CameraModel, FrameHeader
from protocol.transports.link import Message
from protocol.twist_text import format_twist
from vision_side.config import VisionConfig
from vision_side.pipeline import SOURCE, Answer, Frame, Pipeline

VISION_CONFIG = "vision_config"
"""Key of the recording's metadata that holds the configuration of vision, as JSON."""

_FrameId = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Step:
    """One answered frame: what was on the wire (None: an acknowledgement) and what the pipeline says now."""

    frame: Frame
    sent: bytes | None
    answer: Answer

    @property
    def now(self) -> bytes | None:
        """What the pipeline would send."""
        return format_twist(self.answer.twist) if self.answer.twist is not None else None


@dataclass(slots=True)
class Replayed:
    """What a replay found. With answers lost on the way (`gaps`) or frames not recorded, later twists may differ."""

    total: int = 0
    equal: int = 0
    missing_frames: int = 0
    gaps: int = 0
    """Answers that vision numbered and nobody recorded."""
    first_difference: str = ""

    @property
    def ok(self) -> bool:
        """Whether every answer was there and equal."""
        return 0 < self.total == self.equal and not self.missing_frames and not self.gaps


@dataclass(slots=True)
class _Answers:
    """Answers of the recording, by the frame they cite."""

    by_frame: dict[_FrameId, list[tuple[AnswerHeader, bytes | None]]] = field(default_factory=dict)
    gaps: int = 0


def replay(path: Path) -> Replayed:
    """Replay the recording at `path`. Raises ConfigError if it is none."""
    answers = _answers(path)
    result = Replayed(gaps=answers.gaps)
    for step in _steps(path, answers):
        result.total += 1
        result.equal += step.sent == step.now
        if step.sent != step.now and not result.first_difference:
            result.first_difference = f"frame {step.frame.header.seq}: sent {step.sent!r}, now {step.now!r}"
    result.missing_frames = sum(len(some) for some in answers.by_frame.values())
    return result


def replay_steps(path: Path) -> Iterator[Step]:
    """Every answered frame with its answer, in order. Raises ConfigError if `path` is no recording."""
    return _steps(path, _answers(path))


def _steps(path: Path, answers: _Answers) -> Iterator[Step]:
    """Takes out of `answers` what it uses; what is left cites frames that were not recorded."""
    config = _vision_config(path)
    camera = _first_camera(path)
    pipelines: dict[str, Pipeline] = {}
    for recorded in read_recording(path):
        message = recorded.message
        if message.channel is CAMERA:
            model = decode(CameraModel, message.payload, CAMERA.max_payload_bytes)
            if model != camera:
                camera = model
                pipelines.clear()
        if message.channel is not FRAME:
            continue
        frame = Frame(decode(FrameHeader, message.header), message.payload)
        for header, sent in answers.by_frame.pop((frame.header.session, frame.header.seq), ()):
            if sent is None and header.session not in pipelines:
                continue  # before its first twist vision may not have had the camera's model: it only acknowledged
            pipeline = pipelines.setdefault(header.session, Pipeline(config, camera))
            yield Step(frame, sent, pipeline.step(frame))


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
