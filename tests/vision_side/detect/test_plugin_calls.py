"""A plug-in whose code fails beside the looking: one line that names the plug-in, and all other work continues."""

import pytest

from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect import registry as choice
from sightline.vision_side.detect.plugin_calls import attach_detector, close_detector, notices_of


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
