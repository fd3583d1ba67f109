"""A turn that hangs in a plug-in is two lines: where it hangs, and when it ends."""

import sys
import threading
import time
from contextlib import nullcontext

import pytest

from sightline.protocol.errors import ConfigError
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.serving import process
from sightline.vision_side.serving.service import ServingState


class Plugin:
    """A detector that waits in its own code, or in code of Python that it calls."""

    def __init__(self) -> None:
        self.left = threading.Event()

    def detect(self, in_python: bool) -> None:
        if in_python:
            self.left.wait(10)
        while not self.left.is_set():
            time.sleep(0.001)


class Loop:
    """The loop of a service on a thread of its own, with a plug-in."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, look_s: float) -> None:
        monkeypatch.setattr(process, "_LOOK_S", look_s)
        monkeypatch.setattr(process, "LIVE_S", 5 * look_s)
        self.state = ServingState(list, threading.Event(), 0.0, lambda: True)
        self.lines: list[str] = []
        self.plugin = Plugin()

    def end(self) -> None:
        self.state.ending.set()
        self.watching.join(5)

    def wait_lines(self, count: int) -> None:
        ends_s = time.monotonic() + 5
        while len(self.lines) < count and time.monotonic() < ends_s:
            time.sleep(0.002)

    def hang(self, in_python: bool) -> None:
        self.watching = process.watch_turns(self.state, self.lines.append)
        self.plugin.detect(in_python)
        while self.state.turns():
            time.sleep(0.001)


@pytest.mark.parametrize("in_python", [False, True])
def test_turn_that_hangs_is_logged_once_with_its_place_and_its_end(monkeypatch, in_python: bool) -> None:
    loop = Loop(monkeypatch, 0.01)
    hanging = threading.Thread(target=loop.hang, args=(in_python,), daemon=True)
    hanging.start()
    loop.wait_lines(1)
    time.sleep(0.1)
    (line,) = loop.lines
    assert line.startswith(f"vision: no turn ended for 0.05 s: it hangs in Plugin.detect() of {__file__}:")
    loop.plugin.left.set()
    loop.wait_lines(2)
    (line,) = loop.lines[1:]
    assert 0.05 <= float(line.removeprefix("vision: the turn ended after ").removesuffix(" s")) < 5
    loop.end()
    hanging.join(5)
    assert not (loop.watching.is_alive() or hanging.is_alive()) and len(loop.lines) == 2


def test_turns_that_end_log_nothing(monkeypatch) -> None:
    loop = Loop(monkeypatch, 0.02)
    watching = loop.watching = process.watch_turns(loop.state, loop.lines.append)
    for _ in range(30):
        loop.state.turns()
        time.sleep(0.01)
    loop.end()
    assert loop.lines == [] and not watching.is_alive()


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
@pytest.mark.parametrize(("slow_s", "lines"), [(0.01, ["vision: waiting for the detector hsv to load"]), (0.15, [])])
def test_detector_that_loads_slowly_is_named_until_it_is_loaded(monkeypatch, caplog, slow_s, lines, error) -> None:
    def build(_config: VisionConfig) -> str:
        time.sleep(0.1)
        if error is not None:
            raise error
        return "detector"

    caplog.set_level("INFO")
    monkeypatch.setattr(process, "_SLOW_S", slow_s)
    monkeypatch.setattr(process, "configured_detector", build)
    config = VisionConfig(detector=DetectorConfig(kind="hsv"))
    with pytest.raises(ConfigError) if error else nullcontext():
        assert process._loaded_detector(config) == "detector"
    time.sleep(0.1)
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
