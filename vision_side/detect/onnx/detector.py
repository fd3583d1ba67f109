"""The detector `onnx:PATH`. Shell.

Without a path it is the model that comes with Sightline. `onnx:nanodet` is the shipped model of the 80 classes of COCO.
Before the first frame, the detector runs the model to warm up, and checks its answer to a known image. Subclasses open
other engines for models of other frameworks.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import ConfigError, HardwareError, home_path, install_command
from sightline.protocol.log import report_fault
from sightline.protocol.messages import MAX_DETECTED_BOXES
from sightline.vision_side.config import Device, HsvConfig
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.color.hsv import ColorMask, RangeCheck
from sightline.vision_side.detect.color.refine import refined
from sightline.vision_side.detect.onnx.engine import ModelEngine, OnnxHeader, open_engine
from sightline.vision_side.detect.onnx.self_test import KEY, difference, golden_picture, read_golden
from sightline.vision_side.detect.onnx.tensors import (
    ImageTile,
    ModelFormat,
    fit_picture,
    model_format,
    own_labels,
    read_outputs,
    split_batch,
    tile_about,
    view_again,
    vivid,
)
from sightline.vision_side.detect.plugin_calls import DetectorWrapper, notices_of
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Maker, corners, overlap
from sightline.vision_side.detect.timing import timed_together

_MODELS: Final = Path(__file__).parent.parent.parent / "models"
SHIPPED: Final = _MODELS / "sightline.onnx"
NANODET: Final = _MODELS / "nanodet.onnx"
_EXPECTED_BONUS: Final = 0.2
"""Chosen on 500 photographs of BSDS500, which no training uses, each with a random place. There, 0.1, 0.2 and 0.3 give
4.4, 4.8 and 6.8 % of false balls, and 91.8, 94.0 and 96.0 % of hits."""
_EXPECTED_WITHIN: Final = 0.1
"""Distance from the expected place, in image widths, at which the bonus has fallen to 0."""
_DOUBTFUL: Final = 0.5
"""Share of the least score from which an object gets a second look if no track expects it there."""
_SURE: Final = 0.1
"""Margin above the least score that a target needs away from the place where a track expects it."""
_DOUBTED: Final = 0.2
"""Without a track, a target with a smaller margin above the least score is in doubt, too ..."""
_TWICE: Final = 0.05
"""... and the mean score of both looks needs this margin. On the 5000 scenes of "all at once" that choose thresholds,
this gives 1.7 % false alarms and 65.6 % hits (one look: 3.4 and 69.3 %). On 1000 scenes next to boxes of the ball's
color it gives 0 and 90.5 % (2.0 and 88.6 %)."""
HASH_DIGITS: Final = 16
_SAME: Final = 0.3
"""Overlap from which boxes of two looks belong to one object."""
MAX_BYTES: Final = 2**31
"""Size limit of a protocol buffer."""
_WARM_UP: Final = 3
DEFAULT_MIN_SCORE: Final = 0.25  # for a model without `min_score` in its metadata
_NOISE: Final = 0.05
"""Boxes with a lower score may be boxes that the model has suppressed."""
_NAME_LENGTH: Final = 48
_MAX_BATCH: Final = 32
"""Images in one run; limits the memory on a GPU."""
_Place = tuple[float, float]
"""x, y in px of the encoded image."""


class OnnxDetector:
    """A detector with one model."""

    kind: ClassVar[str] = "onnx"

    class Config(Settings):
        """The model, its device, and the limits of its detections."""

        renamed_keys: ClassVar[Mapping[str, str]] = {"colour": "color"}
        address: str = ""
        """The file; empty for the shipped ball model, `nanodet` for the shipped model of humans and COCO classes."""
        device: Device = "auto"
        threads: Annotated[int, Field(ge=1, le=64)] = 1
        """Threads on the CPU. To split a small image only costs time."""
        min_score: Annotated[float | None, Field(ge=0, le=1)] = None
        """None: `min_score` of the model's metadata, or 0.25 if it is missing there."""
        names: Annotated[tuple[str, ...], Field(max_length=1000)] = ()
        """The labels, in order, or `coco` or `coco91`; empty for the labels of the model's metadata."""
        color: Literal["auto", "bgr", "rgb"] = "auto"
        """Channel order of the input; `auto`: bytes are BGR, floats RGB."""
        refine: Annotated[tuple[str, ...], Field(max_length=64)] = ("ball", "sports ball")
        """Labels of round objects. The detector searches for their edge in the image."""
        second_look: bool = True
        """True to enlarge the expected place of the followed target if nothing is detected there. Without a followed
        target, the shipped model also looks again at an object in doubt."""
        expected_bonus: Annotated[float | None, Field(ge=0, le=1)] = None
        """Bonus for the score of a target at its expected place. It falls to 0 at a tenth of the image width from that
        place. None: 0.2 for the model that comes with Sightline, 0 for others."""
        hsv: HsvConfig = HsvConfig()
        color_bonus: Annotated[float, Field(ge=0, le=1)] = 0.3
        """Bonus for the score of a target with a color of `hsv.ranges`, if these differ from the default."""

    def __init__(self, config: Config) -> None:
        """Raises ConfigError for a file without a usable model, HardwareError for an unavailable device."""
        model = self.read_model(config)
        path, self._form, self._min_score = model.path, model.form, model.min_score
        self.labels = model.form.labels
        """All labels that it can give; empty if the model has only numbers."""
        self._refine = frozenset(config.refine)
        self._color = ColorMask(config.hsv.ranges) if config.hsv.ranges != HsvConfig().ranges else None
        self._color_check = RangeCheck(self._color) if self._color else None
        self._colored = self._color
        """Color mask for the current images, or None."""
        self._bonus = config.color_bonus
        # The measures for pale images and for doubts are tested with the shipped models only.
        self._is_shipped = model.digest == shipped_digest() != ""
        own_bonus, given = _EXPECTED_BONUS if self._is_shipped else 0.0, config.expected_bonus
        self._expected_bonus = own_bonus if given is None else given
        # A model without a fixed input size gets the image unscaled, so a part of it would not be larger.
        self._second_look = config.second_look and model.form.size is not None
        self._looks_at_doubts = self._second_look and self._is_shipped
        self._engine = model.engine
        self._notices = [f"{path.name} runs on {self._engine.device}: {self._engine.note}"] if self._engine.note else []
        self.maker = Maker(f"{self.kind}:{path.name}"[:_NAME_LENGTH], model.digest, self._engine.device)
        self._failed = False
        self._max_batch = _MAX_BATCH if self._form.batched else 1
        self._warm_up(model, config)

    @classmethod
    def read_model(cls, config: Any) -> "LoadedModel":
        """Load the model of `config`, a `Config` of this class. Raises ConfigError and HardwareError."""
        return read_onnx_model(config)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Return a result for each frame that still has time, in one batch if the model takes several."""
        return self._in_parts(frames, deadline_us, self._max_batch)

    def notices(self) -> list[str]:
        """Return an unexpected choice of the device, and the first failure."""
        notices, self._notices = self._notices, []
        return notices

    def _in_parts(self, frames: Sequence[DetectFrame], deadline_us: int, most: int) -> list[DetectionResult | None]:
        results: list[DetectionResult | None] = []
        while len(results) < len(frames):
            some = frames[len(results) : len(results) + most]
            is_late = monotonic_us() > deadline_us
            results += [None] * len(some) if is_late else self._run(some, deadline_us)
        return results

    def _run(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        try:
            return timed_together(frames, self.maker, self._detections)
        except Exception as error:  # an engine that fails on an image gives no answer; the first error is reported
            if len(frames) > 1:
                return self._fewer_at_once(frames, deadline_us, error)
            text = report_fault("detector", error)
            if not self._failed:
                self._notices.append(f"{self.maker.detector} gives no answer: {text[:160]}")
            self._failed = True
            return [None]

    def _fewer_at_once(
        self, frames: Sequence[DetectFrame], deadline_us: int, error: Exception
    ) -> list[DetectionResult | None]:
        """Try smaller batches, for a model that fails on large ones. A size that works becomes the limit."""
        fewer = len(frames) // 2
        results = self._in_parts(frames, deadline_us, fewer)
        if any(results) and fewer < self._max_batch:
            self._max_batch = fewer
            self._notices.append(f"{self.maker.detector} fails on {len(frames)} images in one batch, uses at most "
                              f"{fewer}: {str(error)[:120]}")
        return results

    def _detections(self, shown: Sequence[tuple[DetectFrame, DecodedImage]]) -> list[Sequence[Detection]]:
        self._colored = self._color if all(self._is_color_usable(picture) for _, picture in shown) else None
        doubtful = max(_NOISE, self._min_score * _DOUBTFUL) if self._looks_at_doubts else self._min_score
        frames, pictures = [frame for frame, _ in shown], [picture for _, picture in shown]
        places = [frame.expected_px for frame in frames]
        together = self._look(frames, pictures, places, min(self._min_score, doubtful))
        together = [self._counted(*one, found) for one, found in zip(shown, together, strict=True)]
        return [tuple(self._finished(picture, one) for one in found)
                for (_, picture), found in zip(shown, together, strict=True)]

    def _finished(self, picture: DecodedImage, one: Detection) -> Detection:
        """Refine a round object. A detection that passes by its bonus only gets the least score."""
        one = refined(picture, one) if one.label in self._refine else one
        return one if one.score >= self._min_score else replace(one, score=self._min_score)

    def _is_color_usable(self, picture: DecodedImage) -> bool:
        """Return False if the color marks the floor, because any object there would get the bonus."""
        if self._color is None or self._color_check is None:
            return True
        if line := self._color_check.look(picture):
            self._notices.append(f"{line}; until then the color does not count")
            self._color = None
        return not self._color_check.is_flooded

    def _look(
        self, frames: Sequence[DetectFrame], pictures: Sequence[DecodedImage], places: Sequence[_Place | None],
        least: float,
    ) -> list[tuple[Detection, ...]]:
        """Run the model. Return the detections with the score `least` after their bonuses, best first.

        `places` are the expected places in the pictures. The returned score does not include the bonus of a place.
        """
        color_bonus = self._bonus if self._colored else 0.0
        expected_bonus = self._expected_bonus if any(places) else 0.0
        least_score = min(least, max(_NOISE, least - color_bonus - expected_bonus))
        if self._is_shipped:
            pictures = [vivid(picture) for picture in pictures]
        together = _found(self._engine, pictures, self._form, least_score)
        colored = [[self._with_color(frame, picture, one) for one in found]
                   for frame, picture, found in zip(frames, pictures, together, strict=True)]
        return [self._best_first(frame, place, found, least)
                for frame, place, found in zip(frames, places, colored, strict=True)]

    def _with_color(self, frame: DetectFrame, picture: DecodedImage, one: Detection) -> Detection:
        """Add the color bonus to the score of a target of the configured color."""
        if self._colored is None or not frame.goes_by(one.label) or not self._colored.has_color(picture, one):
            return one
        return replace(one, score=min(1.0, one.score + self._bonus))

    def _best_first(
        self, frame: DetectFrame, place: _Place | None, found: Iterable[Detection], least: float = 0.0
    ) -> tuple[Detection, ...]:
        """Sort by the score with the bonus of a target near `place`. Omit detections with less than `least`."""
        raised = [(one.score + self._expected_bonus * _nearness(frame, place, one), one) for one in found]
        best = sorted((pair for pair in raised if pair[0] >= least), key=lambda pair: -pair[0])
        return tuple(one for _, one in best[:MAX_DETECTED_BOXES])

    def _counted(
        self, frame: DetectFrame, picture: DecodedImage, seen: tuple[Detection, ...]
    ) -> tuple[Detection, ...]:
        """Return the detections that count, best first.

        Look again at the enlarged expected place if the first look has no sure target there. A detection that passes
        only by the bonus comes from the enlarged part, or else from the first look.
        """
        found, place = tuple(one for one in seen if one.score >= self._min_score), frame.expected_px
        if place is None:
            return self._without_doubt(frame, picture, seen, found)
        if self._second_look and not _is_any_near(frame, found):
            found = self._with_tile(frame, tile_about(picture, place), found, self._min_score)
        if not _is_any_near(frame, found):
            weak = (one for one in seen if one.score < self._min_score)
            found = self._best_first(frame, place, (*found, *weak), self._min_score)
        return tuple(one for one in found if not self._is_doubtful(frame, one))

    def _is_doubtful(self, frame: DetectFrame, one: Detection) -> bool:
        """Return True for a target with a low score away from its expected place."""
        return (self._looks_at_doubts and frame.goes_by(one.label) and one.score < self._min_score + _SURE
                and not _nearness(frame, frame.expected_px, one))

    def _without_doubt(
        self, frame: DetectFrame, picture: DecodedImage, seen: tuple[Detection, ...], found: tuple[Detection, ...]
    ) -> tuple[Detection, ...]:
        """Look again if the surest target is in doubt. Then each target needs a sufficient mean score of both looks."""
        targets = [one for one in seen if frame.goes_by(one.label)]
        is_sure = not targets or targets[0].score >= self._min_score + _DOUBTED
        if is_sure or frame.looks_once or not self._looks_at_doubts:
            return found
        view = view_again(picture, targets[0])
        (more,) = self._look([frame], [view.picture], [None], _NOISE)
        again = [view.in_image(one) for one in more if frame.goes_by(one.label) and view.shows_all(one)]
        means = [mean for one in targets if (mean := _mean(one, again)).score >= self._min_score + _TWICE]
        return self._best_first(frame, None, [*(one for one in found if not frame.goes_by(one.label)), *means])

    def _with_tile(
        self, frame: DetectFrame, tile: ImageTile, found: tuple[Detection, ...], least: float
    ) -> tuple[Detection, ...]:
        """Return `found` and the other targets in the tile."""
        place = frame.expected_px
        in_tile = place and (place[0] - tile.left_px, place[1] - tile.top_px)
        (more,) = self._look([frame], [tile.picture], [in_tile], least)
        targets = (tile.in_image(one) for one in more if frame.goes_by(one.label) and tile.shows_all(one))
        known = [corners(one) for one in found if frame.goes_by(one.label)]
        new = [one for one in targets if all(overlap(corners(one), box) < _SAME for box in known)]
        return self._best_first(frame, place, (*found, *new))

    def _warm_up(self, model: "LoadedModel", config: Config) -> None:
        """Run the model on the test image and compare the answer with the metadata, or with the CPU."""
        picture, path, expected = DecodedImage(golden_picture(), 1), model.path, model.expected
        form, least = model.own_form, model.own_min_score
        try:
            for _ in range(_WARM_UP):
                (found,) = _found(self._engine, [picture], form, least)
            if expected is None and self._engine.device != "cpu":
                on_cpu = self.read_model(config.model_copy(update={"device": "cpu"})).engine
                expected = list(_found(on_cpu, [picture], form, least)[0])
        except Exception as error:  # an engine may raise any error
            why = " ".join(str(error).split())[:160]
            raise ConfigError(f"model {path} does not run: {why}; see docs/how-to/detectors.md") from None
        wrong = difference(expected, found, least) if expected is not None else ""
        if wrong:
            where = f"{self._engine.device} ({self._engine.name})"
            fix = "try --device cpu, or fetch the file again" if self._engine.device != "cpu" else (
                f"fetch the file again, or remove {KEY!r} from the metadata of a model that you changed or quantized")
            raise HardwareError(f"model {path.name} on {where} gives a wrong answer to its test image: {wrong}; {fix}")


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """A model's file, loaded, and its metadata."""

    path: Path
    engine: ModelEngine
    form: ModelFormat
    min_score: float
    expected: list[Detection] | None
    """Detections in the known image, or None: with its own labels, from its own least score."""
    own_form: ModelFormat
    own_min_score: float
    digest: str

    @property
    def labels(self) -> tuple[str, ...]:
        """All labels that it can give; empty if it has only numbers."""
        return self.form.labels


def _nearness(frame: DetectFrame, place: _Place | None, one: Detection) -> float:
    """Return 1 for a target at its expected place, down to 0 at `_EXPECTED_WITHIN`; 0 without a place."""
    if place is None or not frame.goes_by(one.label):
        return 0.0
    share = math.dist(one.center_px, place) / (_EXPECTED_WITHIN * frame.width_px)
    return max(0.0, 1.0 - share * share)


def _mean(one: Detection, again: Sequence[Detection]) -> Detection:
    """Return a detection with the mean score of both looks. If the other look lacks it, half its own score."""
    shares = [(overlap(corners(one), corners(other)), other) for other in again if other.label == one.label]
    share, same = max(shares, key=lambda pair: pair[0], default=(0.0, one))
    return replace(same, score=(one.score + same.score) / 2) if share >= _SAME else replace(one, score=one.score / 2)


def _is_any_near(frame: DetectFrame, found: Iterable[Detection]) -> bool:
    return any(_nearness(frame, frame.expected_px, one) for one in found)


def read_onnx_model(config: OnnxDetector.Config) -> LoadedModel:
    """Load the model that `config` names.

    Raises:
        ConfigError: for a file that is not a model, or has unknown inputs or outputs.
        HardwareError: for an unavailable device.
    """
    named = {"": SHIPPED, "nanodet": NANODET}
    path = named.get(config.address) or home_path(config.address)
    digest = digest_of(path)
    engine = open_engine(path, config.device, config.threads)
    try:
        header = engine.header
        form, least = model_format(header, config.names, config.color), _least(config.min_score, header)
        if KEY not in header.metadata:
            return LoadedModel(path, engine, form, least, None, form, _least(None, header), digest)
        own = replace(form, labels=own_labels(header.metadata))
        return LoadedModel(
            path, engine, form, least, read_golden(header.metadata[KEY]), own, _least(None, header), digest
        )
    except ValueError as error:
        raise ConfigError(f"model {path}: {error}; see docs/how-to/detectors.md") from None


def _found(
    engine: ModelEngine, pictures: Sequence[DecodedImage], form: ModelFormat, min_score: float
) -> list[tuple[Detection, ...]]:
    """Return the detections of each image; several images only if form and engine accept a batch."""
    fitted = [fit_picture(picture, form) for picture in pictures]
    if len(fitted) == 1:
        each = [engine.run(fitted[0][0])]
    else:
        each = split_batch(engine.run(np.concatenate([pixels for pixels, _ in fitted])), len(pictures))
    return [read_outputs(outputs, form, letterbox, picture, min_score)
            for outputs, (_, letterbox), picture in zip(each, fitted, pictures, strict=True)]


class AutoDetector(DetectorWrapper):
    """The default: the learned model, or the color range for a target that the model does not know."""

    Config = OnnxDetector.Config

    def __init__(self, config: OnnxDetector.Config) -> None:
        is_learned = _is_learned(config)
        super().__init__(OnnxDetector(config) if is_learned else Hsv(Hsv.Config(hsv=config.hsv)))
        notices_of(self.inner)  # drop the notice that no GPU is used: the user has not chosen a model
        self._notices: list[str] = [] if is_learned or config.hsv.shape == "any" else [
            "a color range finds the target, because ONNX Runtime is missing; for the learned detector: "
            + install_command("vision")]

    @classmethod
    def read_model(cls, config: OnnxDetector.Config) -> "LoadedModel | None":
        """Load the model, if one is used. Raises ConfigError and HardwareError."""
        return read_onnx_model(config) if _is_learned(config) else None

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Return the results of the chosen detector."""
        return self.inner.detect(frames, deadline_us)

    def notices(self) -> list[str]:
        """Return the lines of the chosen detector, and once that ONNX Runtime is missing."""
        notices, self._notices = self._notices, []
        return [*notices, *super().notices()]


def _is_learned(config: OnnxDetector.Config) -> bool:
    """Return False for a target of any shape, which no model knows. Also return False if ONNX Runtime is missing and
    no device is required."""
    return config.hsv.shape != "any" and (config.device != "auto" or find_spec("onnxruntime") is not None)


def shipped_digest() -> str:
    """Return the hash of the shipped model as in results; empty without a model."""
    return digest_of(SHIPPED) if SHIPPED.is_file() else ""


def digest_of(*paths: Path) -> str:
    """Return the first digits of the files' SHA-256, as in results. Raises ConfigError, one line."""
    whole = hashlib.sha256()
    for path in paths:
        whole.update(_bytes_of(path))
    return whole.hexdigest()[:HASH_DIGITS]


def _bytes_of(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if not 0 < size < MAX_BYTES:
            raise ConfigError(f"model {path} has {size} bytes; a model file has between 1 and {MAX_BYTES}")
        return path.read_bytes()
    except OSError as error:
        if path in (SHIPPED, NANODET):
            raise ConfigError("this copy of Sightline has no model; name one, e.g. --detector onnx:ball.onnx, or "
                              "train it (docs/explanation/learned-detector.md)") from None
        why = error.strerror or "it cannot be read"
        raise ConfigError(f"model {path}: {why}; check the path, and that you may read it") from None


def _least(given: float | None, header: OnnxHeader) -> float:
    if given is not None:
        return given
    text = header.metadata.get("min_score", DEFAULT_MIN_SCORE)
    try:
        least = float(text)
    except ValueError:
        raise ValueError(f"min_score of its metadata is {text!r}; expected 0 to 1") from None
    if not 0 <= least <= 1:
        raise ValueError(f"invalid min_score {least:g} in its metadata: not between 0 and 1")
    return least
