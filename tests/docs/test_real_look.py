"""The page of the look real: what it runs, and that it hides no failure."""

import re

import pytest

from docs.make.real_look import LEARNED, PAGE, DrawTime, own_detector, page_lines, rows_of, wanted_cases
from sightline.evaluation.score.runs import ScoredFigure
from sightline.sim.scenario import Look, load_scenario, look_named, scenario_names

DRAWS = (
    DrawTime("circle", "real", 10.0, 15.0), DrawTime("walls", "real", 40.0, 50.0), DrawTime("walls", "plain", 3.0, 4.0),
)
COMMAND = "python -m docs.make.real_look --seeds 1,2"


def page(names, scored) -> str:
    return "\n".join(page_lines(wanted_cases(names, [1, 2]), scored, DRAWS, COMMAND))


def figures(name: str, ok: bool, detector: str = " hsv", look: str = " real") -> list[ScoredFigure]:
    group = f"{name}{look}{detector} +50 ms 10% loss"
    return [ScoredFigure(group, "bearing_rms_deg", 0.5, 0.7 if ok else 5.25, "deg", 1.0, ok),
            ScoredFigure(group, "acquired_s", 0.5, None if not ok else 2.0, "s", 30.0, ok)]


def test_page_runs_every_scenario_with_its_own_detector_and_balls_with_the_learned_one():
    wanted = wanted_cases(scenario_names(), [1, 2])
    for look in ("real", None):
        own = {case.scenario for case in wanted if case.detector in (None, "hsv") and case.look == look}
        assert own == set(scenario_names())
    learned = {case.scenario for case in wanted if case.detector == "onnx"}
    assert {"circle", "walls", "chaser"} <= learned
    assert not learned & {"blocks", "legs", "traffic-light", "thymio", "three-boxes"}
    assert {case.seed for case in wanted} == {1, 2}


def test_failed_figure_is_printed_with_worst_median_and_bound():
    text = page(["circle"], [*figures("circle", ok=False), *figures("circle", ok=True, detector=" onnx")])
    rows = {tuple(line.split(" | ")[:2]): line for line in text.splitlines() if line.startswith("| circle |")}
    own, learned = rows["| circle", "`hsv`"], rows["| circle", "`onnx`"]
    assert "| not evaluated | **fails** | bearing_rms_deg 5.25, 0.5 (1 deg); acquired_s never, 0.5 (30 s) |" in own
    assert "|  | ok |  |" in learned
    assert "| `hsv` | 1 | 0 | 0 |" in text and "| `onnx` | 1 | 1 | 1 |" in text


@pytest.mark.parametrize(("worst", "result"), [
    (1.0, "ok"), (1.4, "within x 1.5"), (1.6, "**fails**"), (None, "**fails**"),
])
def test_half_as_much_again_is_granted_in_this_look(worst, result):
    ok = result == "ok"
    scored = [ScoredFigure("circle real hsv +50 ms 10% loss", "bearing_rms_deg", 0.5, worst, "deg", 1.0, ok)]
    text = page(["circle"], scored)
    assert f"| circle | `hsv` | not evaluated | {result} |" in text
    assert f"| `hsv` | 1 | {int(ok)} | {int('fails' not in result)} |" in text


def test_own_look_gets_no_more_than_its_bounds():
    scored = [ScoredFigure("circle hsv +50 ms 10% loss", "bearing_rms_deg", 0.5, 1.4, "deg", 1.0, False)]
    assert "| circle | `hsv` | **fails** | not evaluated |" in page(["circle"], scored)


def test_a_figure_that_leaves_no_room_gets_none():
    scored = [ScoredFigure("circle real hsv +50 ms 10% loss", "wall_contacts", 0.0, 1, "", 0.0, False)]
    assert "| not evaluated | **fails** |" in page(["circle"], scored)


def test_what_fails_without_the_look_too_is_visible():
    text = page(["circle"], [*figures("circle", ok=False), *figures("circle", ok=False, look="")])
    assert "| circle | `hsv` | **fails** | **fails** |" in text
    text = page(["circle"], [*figures("circle", ok=False), *figures("circle", ok=True, look="")])
    assert "| circle | `hsv` | ok | **fails** |" in text


def test_scenario_without_bounds_is_not_ok():
    assert "| not evaluated |" in page(["circle"], figures("circle", ok=True))  # the learned detector has no figure


def test_page_names_its_command_its_seeds_and_the_slowest_scenario():
    text = page(["circle"], figures("circle", ok=True))
    assert f"`{COMMAND}`" in text and "(seeds 1, 2)" in text
    assert "draws 25 images per second (at least 30): **too slow**" in text


def test_scenario_that_runs_again_replaces_its_rows_and_keeps_the_others():
    before = page(["circle", "legs"], [*figures("circle", ok=False), *figures("legs", ok=True, detector="")])
    again = wanted_cases(["circle"], [1, 2])
    text = "\n".join(page_lines(again, figures("circle", ok=True), [], COMMAND, before))
    after = page(["circle", "legs"], [*figures("circle", ok=True), *figures("legs", ok=True, detector="")])
    assert text == after and text != before


def test_page_has_every_row_with_the_bounds_of_its_scenario():
    rows = rows_of(PAGE.read_text())
    cases = [case for case in wanted_cases(scenario_names(), [1]) if case.look == "real"]
    expected = {(case.scenario, f"`{LEARNED}`" if case.detector == LEARNED else own_detector(case.scenario))
                for case in cases}
    assert {(row[0], row[1]) for row in rows} == expected and len(rows) == len(expected)
    for scenario, *_, outside in rows:
        bounds = load_scenario(scenario).bounds
        for name, bound in re.findall(r"(\w+) \S+, \S+ \((\S+) ?\S*\)", outside):
            assert float(bound) == pytest.approx(bounds[name], rel=0.01), scenario


@pytest.mark.parametrize(("name", "expected"), [
    ("circle", "`hsv`"), ("legs", "none: labels of the simulation"), ("thymio", "none: range sensor"),
])
def test_page_names_what_detects(name, expected):
    assert own_detector(name) == expected


def test_page_of_looks_has_every_option_with_its_default_and_its_value_in_real():
    rows = {}
    for line in (PAGE.parents[1] / "looks.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) != 4:
            continue
        names = re.findall(r"`(\w+)`", cells[0])
        for name, default, real in zip(names, cells[1].split(", "), cells[2].split(", "), strict=False):
            rows[name] = (default, real) if len(names) > 1 else (cells[1], cells[2])
    written = {
        name: (shown_value(getattr(Look(), name)), shown_value(getattr(look_named("real"), name)))
        for name in Look.model_fields
    }
    assert rows == written


def shown_value(value) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"{one:g}" for one in value) or "none"
    if isinstance(value, bool):
        return str(value).lower()
    return value if isinstance(value, str) else f"{value:g}"
