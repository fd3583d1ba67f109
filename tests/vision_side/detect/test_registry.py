"""Detectors by name: what is built in, addresses, options, what goes around them, and every mistake as one line."""

import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from sightline.protocol.clock import monotonic_us
from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import DetectorConfig, HsvRange, VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.color.detectors import Adaptive, Hsv
from sightline.vision_side.detect.filters import ColorFilter, LabelFilter, TrackIds
from sightline.vision_side.detect.onnx.detector import AutoDetector, OnnxDetector
from sightline.vision_side.detect.plugin_calls import notices_of
from sightline.vision_side.detect.port import DetectFrame, NoDetector, result_of
from sightline.vision_side.detect.registry import (
    REGISTRY,
    build_detector,
    check_vision,
    configured_detector,
    split_kind,
)
from sightline.vision_side.detect.shadow import ShadowDetector
from tests.fixtures.plugins import with_entries
from tests.fixtures.vision.onnx import brightness_model

pytestmark = pytest.mark.usefixtures("no_gpu")


class Mine:
    """A plug-in in a test, as in a user's file."""

    class Config(Settings):
        address: str = ""
        robot: str = ""
        deadline_s: float = 0.0
        sure: bool = False

    def __init__(self, config: Config) -> None:
        self.config = config

    def detect(self, frames, deadline_us):
        return [result_of(one, (), None) for one in frames]


class NoConfig:
    """Looks like a detector."""


MINE = f"{__name__}:Mine"


def config(**detector: object) -> VisionConfig:
    return VisionConfig(robot="r7", detector=DetectorConfig(**detector))


def test_every_built_in_name_can_be_imported() -> None:
    assert {"hsv", "adaptive", "onnx", "zenoh", "oip+http", "http+jpeg"} <= set(REGISTRY.names())
    for name in REGISTRY.names():
        assert hasattr(REGISTRY.load(name), "detect") and hasattr(REGISTRY.load(name), "Config")


@pytest.mark.parametrize(
    ("kind", "parts"),
    [("hsv", ("hsv", "")), ("onnx:my/ball.onnx", ("onnx", "my/ball.onnx")),
     ("onnx:C:/ball.onnx", ("onnx", "C:/ball.onnx")),
     ("oip+http://box:8000/ball", ("oip+http", "oip+http://box:8000/ball")), ("my_eyes:Eyes", ("my_eyes:Eyes", "")),
     ("zenoh:operator", ("zenoh", "operator"))],
)
def test_kind_is_split_into_name_and_address(kind: str, parts: tuple[str, str]) -> None:
    assert split_kind(kind) == parts


def test_the_configured_detector_always_exists() -> None:
    assert isinstance(configured_detector(VisionConfig()), AutoDetector)
    assert isinstance(configured_detector(config(kind="hsv", options={"label": "ball"})), Hsv)
    assert isinstance(configured_detector(config(kind="adaptive")), Adaptive)
    assert isinstance(configured_detector(config(kind="boxes")), NoDetector)


def test_the_default_is_the_learned_model_where_that_can_find_the_target() -> None:
    made = configured_detector(VisionConfig())
    assert isinstance(made.inner, OnnxDetector) and made.labels[0] == "ball" and not notices_of(made)
    of_any_shape = configured_detector(VisionConfig.model_validate({"hsv": {"shape": "any"}}))
    assert isinstance(of_any_shape.inner, Hsv) and not of_any_shape.labels and not notices_of(of_any_shape)


def test_without_onnx_runtime_a_color_range_finds_the_target_and_that_is_reported_once(monkeypatch) -> None:
    monkeypatch.setattr("sightline.vision_side.detect.onnx.detector.find_spec", lambda _name: None)
    settings = VisionConfig.model_validate({"hsv": {"min_radius_px": 9.0}})
    check_vision(settings)
    made = configured_detector(settings)
    assert isinstance(made.inner, Hsv) and made.inner._hsv_detector._config.min_radius_px == 9.0
    (line,) = notices_of(made)
    assert "ONNX Runtime is missing" in line and "pip install" in line and not notices_of(made)


def test_a_device_that_is_demanded_needs_onnx_runtime(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.setattr("sightline.vision_side.detect.onnx.detector.find_spec", lambda _name: None)
    with pytest.raises(ConfigError, match="onnxruntime is not installed"):
        configured_detector(config(device="cuda"))


def test_own_class_gets_its_options_and_the_vision_values() -> None:
    made = build_detector(MINE, {"sure": True}, config(deadline_s=0.2))
    assert isinstance(made, Mine)
    assert made.config == Mine.Config(robot="r7", deadline_s=0.2, sure=True)
    assert build_detector(MINE, {"robot": "other"}, config()).config.robot == "other"


def test_hsv_takes_the_section_of_its_name_with_its_options_over_it() -> None:
    settings = VisionConfig.model_validate({"hsv": {"min_radius_px": 9.0}})
    made = build_detector("hsv", {"hsv": {"max_contours": 2}}, settings)
    assert (made._hsv_detector._config.min_radius_px, made._hsv_detector._config.max_contours) == (9.0, 2)


def test_boxes_of_another_service_cannot_be_the_fallback() -> None:
    for check in (check_vision, configured_detector):
        with pytest.raises(ConfigError, match=r"^detector\.fallback 'boxes' is remote; choose a local detector"):
            check(VisionConfig.model_validate({"detector": {"kind": "hsv", "fallback": "boxes"}}))


@pytest.mark.parametrize("name", ["saturation", "value"])
def test_color_range_that_no_pixel_is_in_is_rejected(name: str) -> None:
    one = {"hue_low_deg": 300, "hue_high_deg": 20, f"{name}_low": 0.9, f"{name}_high": 0.1}
    with pytest.raises(ValidationError, match=f"{name}_low 0.9 is above {name}_high 0.1; set both"):
        HsvRange.model_validate(one)
    HsvRange.model_validate(one | {f"{name}_high": 0.9})


def test_wrappers_are_built_from_the_inside_out() -> None:
    made = configured_detector(config(kind="hsv", labels=("ball",), only_color=True, tracked=True, shadow="adaptive"))
    assert isinstance(made, ShadowDetector)
    made.close()
    tracked = made._driving
    assert isinstance(tracked, TrackIds) and isinstance(tracked.inner, ColorFilter)
    assert isinstance(tracked.inner.inner, LabelFilter) and isinstance(tracked.inner.inner.inner, Hsv)


def test_fallback_has_the_same_label_filter() -> None:
    large = (2000, 1200)
    jpeg = cv2.imencode(".jpg", np.full((large[1], large[0], 3), 120, np.uint8))[1].tobytes()
    made = configured_detector(config(kind="hsv", fallback="adaptive").model_copy(update={"max_pixels": 3_000_000}))
    header = FrameHeader(session="0000abcd", seq=1, t_us=1)
    (result,) = made.detect([DetectFrame("r1", header, jpeg, Decoder(*large, 3_000_000))], monotonic_us() + 2_000_000)
    made.close()
    assert result.detector == "hsv" and not notices_of(made)


@pytest.mark.parametrize(
    ("detector", "words"),
    [
        ({"kind": "hsw"}, "no detector called 'hsw'; did you mean 'hsv'"),
        ({"kind": "nowhere:Finder"}, "'nowhere:Finder' cannot be loaded"),
        ({"kind": "onx:ball"}, "No module named 'onx'; did you mean 'onnx'?"),
        ({"kind": "onx:models/ball.onnx"}, "no detector called 'onx:models/ball.onnx'; did you mean 'onnx'?"),
        ({"kind": "http://box/detect"}, "no detector called 'http://box/detect'; did you mean 'oip+http'?; there are"),
        ({"kind": f"{__name__}:Gone"}, "cannot be loaded"),
        ({"kind": f"{__name__}:NoConfig"}, "NoConfig': not a class with a pydantic model called Config"),
        ({"kind": "hsv:red"}, "takes nothing after its name, not 'red'"),
        ({"kind": "hsv", "options": {"hue": 3}}, "unknown option 'hue'; it takes hsv, label"),
        ({"kind": "onnx:/nowhere/ball.onnx"}, "No such file"),
        ({"kind": "adaptive", "options": {"confirm": 0}}, "option 'confirm'"),
        ({"kind": "hsv", "device": "cuda"}, "no device to choose"),
        ({"kind": "boxes", "shadow": "hsv"}, "detector.shadow goes with a local detector"),
        ({"kind": "boxes", "device": "cuda"}, "detector.device goes with a local detector"),
        ({"kind": "boxes", "options": {"min_score": 0.5}}, "detector.options goes with a local detector"),
        ({"kind": "boxes", "shadow_options": {"a": 1}}, "detector.shadow_options goes with"),
        ({"kind": "hsv", "shadow": "hsw"}, "did you mean 'hsv'"),
    ],
)
def test_every_mistake_is_one_line(detector: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)) as refused:
        configured_detector(config(**detector))
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 300


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"target": {"label": "bal"}}, "mission 'follow': onnx has no label 'bal'; did you mean 'ball'?"),
        ({"mission": {"kind": "follow", "options": {"target": {"label": "bal"}}}}, "mission 'follow': onnx has no"),
        ({"mission": {"kind": "legs", "options": {"label": "person"}}}, "mission 'legs': onnx has no label 'person'"),
        ({"mission": {"kind": "traffic-light"}},
         "mission 'traffic-light': onnx has no label 'target'; only a color detector gives it, e.g. --detector hsv"),
        ({"detector": {"kind": "onnx", "labels": ["bal"]}}, "detector.labels: onnx has no label 'bal'"),
        ({"detector": {"kind": "onnx", "labels": ["bal"], "fallback": "hsv"}}, "detector.labels: onnx has no label"),
        ({"detector": {"kind": "hsv", "labels": ["target"], "shadow": "onnx"}}, "detector.labels: onnx has no label"),
        ({"detector": {"kind": "hsv", "labels": ["person"], "fallback": "onnx"}}, "detector.labels: onnx has no label"),
        ({"detector": {"kind": "hsv", "fallback": "onnx"}, "target": {"label": "person"}},
         "mission 'follow': onnx has no label 'person'"),
    ],
)
def test_label_that_the_model_never_gives_is_rejected(settings: dict, words: str) -> None:
    vision = VisionConfig.model_validate({"detector": {"kind": "onnx"}, **settings})
    for check in (check_vision, configured_detector):
        with pytest.raises(ConfigError, match=re.escape(words)):
            check(vision)


def test_label_that_only_the_shadow_lacks_is_rejected_with_its_name(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", [[1, 1, 9, 9]], [0], words=("cup", "plate"))
    with pytest.raises(ConfigError, match=re.escape(f"detector.labels: onnx:{path} has no label 'ball'")):
        configured_detector(config(kind="hsv", labels=("ball",), shadow=f"onnx:{path}"))


@pytest.mark.parametrize("settings", [{"mission": {"kind": "legs"}}, {"target": {"label": "ball"}}, {}])
def test_label_of_the_model_is_accepted(settings: dict) -> None:
    assert isinstance(configured_detector(VisionConfig.model_validate({"detector": {"kind": "onnx"}, **settings})),
                      OnnxDetector)


class Entry:
    """An entry point as an installed package has it."""

    def __init__(self, name: str, loaded: object) -> None:
        self.name, self.loaded = name, loaded

    def load(self) -> object:
        if isinstance(self.loaded, Exception):
            raise self.loaded
        return self.loaded


def test_an_installed_package_brings_its_detectors_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = [Entry("lens", Mine), Entry("broken", ImportError("no module named lens"))]
    with_entries(monkeypatch, REGISTRY.group, *installed)
    made = build_detector("lens:/dev/lens0", {"sure": True}, config())
    assert isinstance(made, Mine) and made.config == Mine.Config(address="/dev/lens0", robot="r7", deadline_s=0.1,
                                                                 sure=True)
    assert isinstance(configured_detector(config(kind="lens", tracked=True)).inner, Mine)
    with pytest.raises(ConfigError, match="'broken' cannot be loaded: no module named lens"):
        build_detector("broken", {}, config())
    with pytest.raises(ConfigError, match="did you mean 'lens'"):
        build_detector("lense", {}, config())


def test_device_is_passed_only_to_plugins_that_accept_one(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", [[1, 1, 9, 9]], [0])
    assert isinstance(configured_detector(config(kind=f"onnx:{path}", device="cpu")), OnnxDetector)
    with pytest.raises(HardwareError, match="--device cuda"):
        configured_detector(config(kind=f"onnx:{path}", device="cuda"))


class Older(Mine):
    """A plug-in whose notices have their name of the release before."""

    def news(self):
        return ["warm"]


def test_renamed_hook_of_a_plug_in_is_accepted_with_one_warning(caplog) -> None:
    for _ in range(2):
        assert notices_of(build_detector(f"{__name__}:Older", {}, config())) == ["warm"]
    assert caplog.messages == [f"detector '{__name__}:Older': method 'news' is now 'notices'; rename it"]
