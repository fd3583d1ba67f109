"""The behaviors page follows from the runs: figures, results, baselines next to defaults, images."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import pytest

from docs.make.behaviors import (
    CHARACTER,
    GOALS_M,
    LAWS,
    LOOKS,
    NOT_MEASURED,
    ROWS,
    TABLES,
    Row,
    SpeedCase,
    free_way,
    kept,
    merged,
    page_lines,
    picture_name,
    speed_cases,
    speed_run,
    speeds_of,
    table_lines,
    write_page,
)
from sightline.evaluation.plots import plot_run
from sightline.evaluation.processes import worker_pool
from sightline.evaluation.score.figures import Score
from sightline.sim.scenario import load_scenario, scenario_names
from tests.evaluation.score.test_figures import truth

pytestmark = pytest.mark.computes

SEEDS = (901, 902)
GOOD = Score(
    acquired_s=1.0, found_s=0.0, bearing_rms_deg=0.2, distance_rms_m=0.01, lost_percent=0.0, wall_contacts=0,
    travelled_m=1.0, seconds=5.0,
    figures={"crossed_on_red": 0, "crossed_late": 0, "least_crossings": 1, "least_red_stops": 1, "most_aside_m": 0.1,
             "start_s": 0.2,
             "wrong_states_percent": 0.0},
)


def page(row, *scores, looks=()):
    results = dict(zip(row.all_cases(SEEDS), scores, strict=True))
    if row.baseline:
        results |= dict.fromkeys(row.default.cases(SEEDS), GOOD)
    return "\n".join(page_lines([row], results, SEEDS, "pictures", [])), kept(row, results, SEEDS)


def test_median_and_worst_and_whether_the_bound_was_kept():
    text, ok = page(Row("ball"), GOOD, replace(GOOD, bearing_rms_deg=0.6))
    assert "| bearing_rms_deg | 0.4 deg | 0.6 deg | 1 deg | ok |" in text and ok
    assert "| 2 of 2 | bearing_rms_deg 0.6 deg, 60% |" in text
    text, ok = page(Row("ball"), GOOD, replace(GOOD, bearing_rms_deg=1.01, lost_percent=None))
    assert "| bearing_rms_deg | 0.605 deg | 1.01 deg | 1 deg | **not kept** |" in text and not ok
    assert "| lost_percent | 0 % | never | 0 % | **not kept** |" in text and "| 1 of 2 |" in text


def test_baseline_is_shown_next_to_the_default_with_its_failures():
    lost = replace(GOOD, acquired_s=None, bearing_rms_deg=None, lost_percent=None, unseen_percent=72.0)
    text, ok = page(Row("ball", "pixel-pi"), lost, GOOD)
    assert ok, "nothing is demanded of it"
    assert ("It breaks these bounds of `follow`, with the number of 2 starts: acquired_s (1), bearing_rms_deg (1), "
            "lost_percent (1).") in text
    assert "| bearing_rms_deg | 0.2 deg | never | 0.2 deg | 0.2 deg |" in text
    assert "| unseen_percent | 36 % | 72 % | 0 % | 0 % |" in text
    assert "stays within all bounds of `follow` here" in page(Row("ball", "pixel-pi"), GOOD, GOOD)[0]


def test_each_light_has_its_line_and_one_that_is_misread_fails_the_row():
    row = Row("traffic-light", looks=("dim", "warm"))
    misread = replace(GOOD, figures={**GOOD.figures, "wrong_states_percent": 0.5})
    text, ok = page(row, GOOD, GOOD, GOOD, GOOD, misread, GOOD)
    assert "| dim | 0 % | 0 times | 0 times | 1 times | 0.2 s | ok |" in text
    assert "| warm | 0.5 % | 0 times | 0 times | 1 times | 0.2 s | **not kept** |" in text
    assert not ok and "| 5 of 6 |" in text


def test_every_row_has_its_image_and_heading():
    for key in (lambda row: picture_name(row.cases(SEEDS)[0]), lambda row: row.title, lambda row: row.anchor):
        assert len({key(row) for row in ROWS}) == len(ROWS)


def test_every_behavior_and_every_baseline_has_its_row():
    basics = {"static", "circle", "eight", "pushed", "behind", "walls"}  # the performance page has these
    assert {row.scenario for row in ROWS} == set(scenario_names()) - basics
    assert {row.baseline for row in ROWS if row.baseline} == set(CHARACTER)
    assert all(CHARACTER.values())
    assert LOOKS == ("dim", "bright", "warm", "desaturated", "quality30")


def test_identity_is_measured_on_twenty_starts_in_both_looks_and_the_circle_in_four_lights():
    plain, real, light = TABLES
    assert len(set(plain.seeds)) == len(set(real.seeds)) == 20
    crossed = {name for name in scenario_names() if "found_again_s" in load_scenario(name).bounds}
    assert {*plain.lines(), *real.lines()} == {(name, look) for name in crossed for look in ("plain", "real")}
    assert plain.figures == real.figures == ("wrong_percent", "lost_after_s", "found_again_s")
    assert [look for _, look in light.lines()] == ["tungsten", "fluorescent", "dark", "pale"]
    assert {case.detector for table in TABLES for line in table.lines() for case in table.cases(*line)} == {None}


def test_line_of_a_table_is_of_the_worst_start_against_the_bound():
    light = replace(TABLES[2], seeds=SEEDS)
    results = {case: GOOD for look in ("dark", "pale") for case in light.cases("circle", look)}
    results[light.cases("circle", "pale")[1]] = replace(GOOD, bearing_rms_deg=1.01)
    text = "\n".join(table_lines(light, results))
    assert "| circle | dark | 0.2 deg (bound 1 deg) | 0 % (bound 0 %) | ok |" in text
    assert "| circle | pale | 1.01 deg (bound 1 deg) | 0 % (bound 0 %) | **not kept** |" in text
    assert f"| circle | tungsten | {NOT_MEASURED} (bound 1 deg) | {NOT_MEASURED} (bound 0 %) | {NOT_MEASURED} |" in text


def test_parts_that_run_again_replace_their_lines_and_no_others():
    good, bad = (page_of([Row("ball"), Row("blocks")], one) for one in (GOOD, replace(GOOD, lost_percent=1.0)))
    again = page_of([Row("blocks")], replace(GOOD, lost_percent=1.0))
    text = merged(good, again)
    assert text == good.replace(good.partition("| [blocks]")[2].partition("\n")[0],
                                bad.partition("| [blocks]")[2].partition("\n")[0]).replace(
        good.partition("## blocks")[2], bad.partition("## blocks")[2])
    assert merged(good, good) == good
    lines = page_of([], GOOD, tables=TABLES[2:])
    assert merged(good, lines) == good + "\n## Light" + lines.partition("\n## Light")[2]


def page_of(rows, result, tables=()):
    results = dict.fromkeys((case for row in rows for case in row.all_cases(SEEDS)), result)
    return "\n".join(page_lines(rows, results, SEEDS, "pictures", [], tables=tables))


# --- speed and acceleration --------------------------------------------------------------------------------------


def test_both_laws_drive_every_way():
    wishes = speed_cases(901)
    assert {(wish.law, wish.goal_m) for wish in wishes} == {(law, goal_m) for law in LAWS for goal_m in GOALS_M}
    assert GOALS_M == (0.2, 2.0, 10.0)
    for goal_m in GOALS_M:
        way = free_way(goal_m)
        assert way.things == way.walls == () and way.goals_m == ((goal_m, 0.0),)


@pytest.mark.parametrize("slope_mps2", [0.5, -1.25])
def test_an_acceleration_is_the_slope_of_the_speed(slope_mps2):
    run = [replace(truth(at / 50, x_m=at / 100), linear_mps=1.0 + slope_mps2 * at / 50) for at in range(101)]
    drive = speeds_of(SpeedCase("goto", 1.0, 901), run)
    assert drive.accelerations_mps2 == pytest.approx([slope_mps2] * 101)
    assert drive.arrived_s == pytest.approx(1.9) and drive.off_m == pytest.approx(0.0)
    assert drive.top_mps == max(1.0, 1.0 + 2 * slope_mps2)


def test_both_laws_reach_a_near_waypoint():
    """In the real lockstep, the one that stops; the legacy controller arrives too, because nothing is in the way."""
    for law in LAWS:
        drive = speed_run(SpeedCase(law, 0.2, 901))
        assert drive.arrived_s is not None and drive.arrived_s < 5.0
        assert drive.off_m < 0.06 and 0.05 < drive.top_mps <= 0.5 and abs(drive.speeds_mps[-1]) < 0.01


@contextmanager
def workers_in_this_process(jobs):
    with ThreadPoolExecutor(jobs) as pool:
        yield pool


def write_samples(path, samples, scenario, title):
    path.write_bytes(b"\x89PNG" + f"{scenario.name} {title} {len(samples)}".encode())


@pytest.mark.parametrize(("workers", "plot"), [
    (workers_in_this_process, write_samples),  # a process and Matplotlib take longer than the runs
    pytest.param(worker_pool, plot_run, marks=pytest.mark.slow),
])
def test_the_command_writes_the_page_and_a_picture_of_the_first_start(workers, plot, tmp_path, monkeypatch):
    rows, advanced = [Row("legs-slow", seconds=1.5), Row("legs-slow", "legs-baseline", seconds=1.5)], []

    @contextmanager
    def progress(total):
        yield lambda: advanced.append(total)

    monkeypatch.setattr("docs.make.behaviors.progress_bar", progress)
    monkeypatch.setattr("docs.make.behaviors.worker_pool", workers)
    monkeypatch.setattr("docs.make.behaviors.plot_run", plot)
    path = tmp_path / "behaviors.md"
    ok = write_page(path, [905], 1, rows)
    text = path.read_text()
    assert ok == ("**not kept**" not in text) and advanced == [2, 2]
    assert sorted(one.name for one in (tmp_path / "behaviors").iterdir()) == [
        "legs-slow-legs-baseline.png", "legs-slow.png"]
    assert all(one.read_bytes().startswith(b"\x89PNG") for one in (tmp_path / "behaviors").iterdir())
    assert load_scenario("legs-slow").summary[1:] in text and "## legs-slow, baseline `legs-baseline`" in text
