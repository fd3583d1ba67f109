"""A plug-in whose code fails beside the looking: one line that names the plug-in, and all other work continues."""

import re
from dataclasses import replace

import numpy as np
import pytest

from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect import registry as choice
from sightline.vision_side.detect.plugin_calls import attach_detector, close_detector, labels_of, notices_of, validated
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult


class Failing:
    def __init__(self, error: Exception) -> None:
        self._error = error

    def _fail(self, *_: object) -> None:
        raise self._error

    attach = close = notices = _fail


def test_error_of_a_plug_in_gives_one_line_with_its_place() -> None:
    bad = Failing(RuntimeError("two\nlines"))
    for what, ask in (("attach", lambda: attach_detector(bad, None)), ("close", lambda: close_detector(bad))):
        with pytest.raises(ConfigError, match=rf"{what}\(\) raises RuntimeError: two lines; fix the plug-in"):
            ask()
    with pytest.raises(HardwareError, match="no camera"):
        close_detector(Failing(HardwareError("no camera")))


class Labels:
    def __init__(self, labels: object) -> None:
        self._labels = labels

    @property
    def labels(self) -> object:
        if isinstance(self._labels, Exception):
            raise self._labels
        return self._labels


@pytest.mark.parametrize(("labels", "words"), [
    (RuntimeError("boom"), "raises RuntimeError: boom"), (5, "raises TypeError: 5 is not a sequence of texts"),
    ("ball", "raises TypeError: 'ball' is not a sequence of texts"),
])
def test_invalid_labels_of_a_plug_in_are_one_line(labels: object, words: str) -> None:
    with pytest.raises(ConfigError, match=f"^the detector's labels {words}; fix the plug-in"):
        labels_of(Labels(labels))
    assert labels_of(Labels(["ball", "cup"])) == ("ball", "cup") and labels_of(object()) == ()


@pytest.mark.parametrize(("track_id", "expected"), [(np.int64(3), 3), (True, 1), (7, 7), (None, None)])
def test_track_number_of_any_kind_of_integer_is_sent(track_id: object, expected: int | None) -> None:
    (one,) = validated(FRAME, answer(track_id)).detections
    assert (one.track_id, type(one.track_id)) == (expected, type(expected))


@pytest.mark.parametrize("track_id", [1.5, "3", np.float32(3), -1, 2**53])
def test_other_track_numbers_are_invalid(track_id: object) -> None:
    with pytest.raises(ValueError, match=f"a track number {track_id}; expected an integer from 0"):
        validated(FRAME, answer(track_id))


@pytest.mark.parametrize("label", [3, np.int64(3), None, b"x" * 500])
def test_label_that_is_not_text_is_named(label: object) -> None:
    result = answer(0)
    wrong = replace(result, detections=(replace(result.detections[0], label=label),))
    with pytest.raises(ValueError, match=re.escape(f"invalid label {label!r}: not text"[:160]) + "$"):
        validated(FRAME, wrong)


HEADER = FrameHeader(session="0000abcd", seq=1, t_us=1)
FRAME = DetectFrame("r1", HEADER, b"", Decoder(320, 240, 320 * 240))


def answer(track_id: object) -> DetectionResult:
    box = Detection(1.0, 1.0, 9.0, 10.0, 0.5, "ball", track_id=track_id)  # type: ignore[arg-type]
    return DetectionResult("r1", HEADER.session, 1, 1, 320, 240, (box,), "tested")


def test_detector_with_failing_notices_continues() -> None:
    (line,) = notices_of(Failing(KeyError("x" * 500)))
    assert "notices() raises KeyError" in line and len(line) <= 160
    assert notices_of(object()) == []


def test_a_plug_in_that_cannot_be_made_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        class Config(Settings):
            pass

        def __init__(self, config: Config) -> None:
            raise RuntimeError("no memory")

    monkeypatch.setattr(choice, "_checked", lambda *_: (Broken, Broken.Config()))
    with pytest.raises(ConfigError, match="mine:Broken, when it is made, raises RuntimeError: no memory"):
        choice.build_detector("mine:Broken", {}, VisionConfig())
