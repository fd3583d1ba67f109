"""docs/how-to: at most ten steps a list, every file and folder that a page names exists, and its programs run."""

import re
import sys
import textwrap
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.fixtures.links import until

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted(page for kind in ("add-*.md", "write-*.md") for page in (ROOT / "docs" / "how-to").glob(kind))
NAMED = re.compile(r"`([a-z_]+/[\w/.-]*|pyproject\.toml)`")
SOURCE = "https://github.com/sightline-robot/sightline/blob/main/"
LINKED = re.compile(r"\]\(([^)]+)\)")


def test_how_to_folder_has_the_agreed_pages():
    assert {page.stem for page in PAGES} == {
        "add-a-device", "add-a-status-field", "add-a-command", "write-a-mission", "write-a-detector",
    }  # fmt: skip


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_has_at_most_ten_steps_and_names_what_exists(page):
    text = page.read_text()
    steps = [int(number) for number in re.findall(r"^(\d+)\. ", text, re.MULTILINE)]
    assert steps and max(steps) <= 10
    for path in NAMED.findall(text):
        assert (ROOT / path).exists(), path
    for target in LINKED.findall(text):
        link = target.partition("#")[0]
        assert (ROOT / link.removeprefix(SOURCE) if link.startswith(SOURCE) else page.parent / link).exists(), link


def test_watchdog_of_the_legacy_page_has_ten_lines_and_stops_a_robot_without_commands():
    page = (ROOT / "docs/how-to/legacy-robots.md").read_text()
    code = page.partition("<!-- watchdog -->\n```python\n")[2].partition("```")[0]
    assert len([line for line in code.splitlines() if line]) == 10
    names, stops = {}, []
    exec(code, names)  # the reader's own program runs it too
    feed = names["watchdog"](lambda: stops.append(time.monotonic()), 0.2)
    feeds = []
    for _ in range(10):
        feeds.append(time.monotonic())
        feed()
        time.sleep(0.03)
    assert until(lambda: stops and stops[-1] > feeds[-1], 1.0)
    # On a busy machine two feeds may be so far apart that it stops the robot between them, rightly.
    assert all(stop_s - max(fed_s for fed_s in feeds if fed_s < stop_s) >= 0.2 for stop_s in stops)
    feed()


def test_contract_program_of_the_device_page_checks_the_drive_of_the_examples(monkeypatch):
    page = (ROOT / "docs/how-to/add-a-device.md").read_text()
    code = textwrap.dedent(page.partition("<!-- contract -->\n")[2].partition("```python\n")[2].partition("```")[0])
    monkeypatch.syspath_prepend(ROOT / "examples")
    exec(code, names := {})  # the reader's own program
    monkeypatch.setattr(names["MyDrive"], "set", lambda *_speeds: None)
    with pytest.raises(AssertionError):
        exec(code, {})


class CutOff:
    """Runs the sketch of the page on a simulated pulse train, a loop per millisecond."""

    def __init__(self, monkeypatch, level_at, end_ms):
        run = self
        self.now_ms, self.enabled = 0, []
        pins = {2: lambda: level_at(self.now_ms), 3: None}

        class Pin:
            IN, OUT, PULL_DOWN = "in", "out", "down"

            def __init__(self, number, mode, pull=None, value=None):
                self.read = pins[number]
                assert (mode, pull, value) == (("in", "down", None) if self.read else ("out", None, 0))

            def value(self, new=None):
                if new is None:
                    return self.read()
                run.enabled.append((run.now_ms, bool(new)))
                return None

        def ticks_ms():
            run.now_ms += 1
            if run.now_ms > end_ms:
                raise EOFError
            return (2**30 - 500 + run.now_ms) % 2**30  # as on the device, the count starts again at 2^30

        def ticks_diff(later, earlier):
            return (later - earlier + 2**29) % 2**30 - 2**29

        watchdog = SimpleNamespace(feed=lambda: None)
        monkeypatch.setitem(sys.modules, "machine", SimpleNamespace(Pin=Pin, WDT=lambda timeout: watchdog))
        monkeypatch.setitem(sys.modules, "time", SimpleNamespace(ticks_ms=ticks_ms, ticks_diff=ticks_diff))
        page = (ROOT / "docs/how-to/hardware-cutoff.md").read_text()
        code = page.partition("<!-- cutoff -->")[2].partition("```python\n")[2].partition("```")[0].rstrip(" ")
        assert len([line for line in code.splitlines() if line]) <= 20
        with pytest.raises(EOFError):
            exec(textwrap.dedent(code), {})

    def enabled_ms(self):
        """Return when the motors had power, first and last."""
        times = [now_ms for now_ms, is_on in self.enabled if is_on]
        return (times[0], times[-1]) if times else None


def pulses(until_ms, then, period_ms=20, begin_ms=0):
    """A level that changes each `period_ms` from `begin_ms` to `until_ms`; then it is `then`."""
    return lambda now_ms: then if now_ms > until_ms else max(0, now_ms - begin_ms) // period_ms % 2


@pytest.mark.parametrize("then", [0, 1])
@pytest.mark.parametrize("period_ms", [2, 20, 140])
def test_cutoff_of_the_page_follows_the_pulses_of_the_control_loop(monkeypatch, then, period_ms):
    last_change_ms = 700 // period_ms * period_ms
    cut = CutOff(monkeypatch, pulses(last_change_ms, last_change_ms // period_ms % 2, period_ms), 2000)
    first_ms, last_ms = cut.enabled_ms()
    assert abs(first_ms - 5 * period_ms) <= 2, "five changes release it"
    assert abs(last_ms - (last_change_ms + 150)) <= 2, "150 ms after the last change the motors are without power"
    again = CutOff(monkeypatch, lambda now_ms: then, 1000)
    assert again.enabled_ms() is None


def test_cutoff_of_the_page_ignores_single_edges_and_silence(monkeypatch):
    assert CutOff(monkeypatch, pulses(10_000, 0, period_ms=160), 5000).enabled_ms() is None
    assert CutOff(monkeypatch, lambda now_ms: now_ms > 500, 2000).enabled_ms() is None
