"""A turn that hangs in a plug-in is two lines: where it hangs, and when it ends."""

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import nullcontext

import pytest

from sightline.protocol import log
from sightline.protocol.errors import ConfigError
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.serving import process
from sightline.vision_side.serving.service import LIVE_S, ServingState
from tests.fixtures.links import until


class Plugin:
    """A detector that waits in its own code, or in code of Python that it calls."""

    def __init__(self) -> None:
        self.began, self.left = threading.Event(), threading.Event()

    def detect(self, in_python: bool) -> None:
        self.began.set()
        if in_python:
            self.left.wait(30)
        while not self.left.is_set():
            time.sleep(0.001)


class Looks(threading.Event):
    """The end of a service whose watcher looks without a clock, so that no test is too late."""

    def __init__(self) -> None:
        super().__init__()
        self.state = ServingState(list, self, 0.0, lambda: True)
        self.turned: Iterator[bool] = iter(())

    def wait(self, _seconds: float | None = None) -> bool:
        """Turn before this look if `turned` has a True for it. After the last look the service ends."""
        if (turns := next(self.turned, None)) is None:
            return True
        self.state.turned_s += turns
        return False


def reported(turned: Iterable[bool], thread: int) -> list[str]:
    lines: list[str] = []
    looks = Looks()
    looks.turned = iter(turned)
    process._report_hangs(looks.state, thread, lines.append)
    return lines


@pytest.mark.parametrize("in_python", [False, True])
def test_turn_that_hangs_is_logged_once_with_its_place_and_its_end(in_python: bool) -> None:
    plugin = Plugin()
    hanging = threading.Thread(target=plugin.detect, args=(in_python,), daemon=True)
    hanging.start()
    assert plugin.began.wait(30) and hanging.ident is not None
    most = round(LIVE_S / process._LOOK_S)
    lines = reported([True, *[False] * (most + 2), True, True], hanging.ident)
    plugin.left.set()
    hanging.join(30)
    assert len(lines) == 2
    assert lines[0].startswith(f"vision: no turn ended for {LIVE_S:g} s: it hangs in Plugin.detect() of {__file__}:")
    assert lines[1] == f"vision: the turn ended after {LIVE_S + 2 * process._LOOK_S:g} s"


def test_turns_that_end_log_nothing() -> None:
    slow = [*[False] * (round(LIVE_S / process._LOOK_S) - 1), True]
    assert reported(3 * slow, threading.get_ident()) == []


def test_watcher_ends_with_the_service() -> None:
    state = ServingState(list, threading.Event(), 0.0, lambda: True)
    state.ending.set()
    watching = process.watch_turns(state, str)
    watching.join(30)
    assert not watching.is_alive() and watching.daemon


def test_service_watches_its_turns_and_passes_its_state_on(monkeypatch) -> None:
    state, watched, observed = object(), [], []
    monkeypatch.setattr(process, "watch_turns", lambda state, report: watched.append(state) or report)
    for name in ("configured_mission", "configured_detector", "close_detector", "date_problem"):
        monkeypatch.setattr(process, name, lambda *_: "")
    monkeypatch.setattr(process, "_run_one", lambda _config, _ending, observe, *_: observe(state) or 0)
    config = VisionConfig()
    assert process.run(config) == process.run(config, observed.append) == 0
    assert watched == [state, state] and observed == [state]


@pytest.mark.parametrize("error", [None, ConfigError("no such file")])
@pytest.mark.parametrize("lines", [["vision: waiting for the detector hsv to load"], []])
def test_detector_that_loads_slowly_is_named_until_it_is_loaded(monkeypatch, caplog, lines, error) -> None:
    def build(_config: VisionConfig) -> str:
        assert until(lambda: caplog.messages == lines)
        if error is not None:
            raise error
        return "detector"

    caplog.set_level("INFO")
    monkeypatch.setattr(log, "_SLOW_S", 0.01 if lines else 60.0)
    monkeypatch.setattr(process, "configured_detector", build)
    for name in ("configured_mission", "close_detector", "date_problem"):
        monkeypatch.setattr(process, name, lambda *_: "")
    monkeypatch.setattr(process, "_run_one", lambda _config, _ending, _observe, detector, _guard: detector)
    made: list[threading.Timer] = []
    usual = threading.Timer
    monkeypatch.setattr(threading, "Timer", lambda *given: made.append(usual(*given)) or made[-1])
    config = VisionConfig(detector=DetectorConfig(kind="hsv"))
    with pytest.raises(ConfigError) if error else nullcontext():
        assert process.run(config) == "detector"
    (waiting,) = made
    waiting.join(30)
    assert not waiting.is_alive()
    assert caplog.messages == lines


@pytest.mark.parametrize(("file", "place"), [
    ("{python}/json/decoder.py", ""), ("{python}/site-packages/plugin.py", "own"),
    ("{python}/dist-packages/plugin.py", "own"), ("/home/user/plugin.py", "own"),
])
def test_place_is_in_the_newest_code_that_is_not_of_python(monkeypatch, file: str, place: str) -> None:
    file = file.format(python=process._PYTHON)
    found: dict[str, object] = {"process": process, "threading": threading}
    exec(compile("def own():\n    return process._place(threading.get_ident())", file, "exec"), found)
    own, here = found["own"], test_place_is_in_the_newest_code_that_is_not_of_python.__name__
    monkeypatch.setattr(process.sys, "_current_frames", lambda: {threading.get_ident(): sys._getframe(2)})
    assert own().startswith(f"own() of {file}:2" if place else f"{here}() of {__file__}:")
