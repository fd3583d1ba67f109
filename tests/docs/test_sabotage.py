"""The sabotage page follows from the runs: what broke, what is unchanged and why, what passes."""

import pytest

from docs.make.sabotage import MEANINGS, page_lines
from sightline.evaluation.score import sabotage
from sightline.evaluation.score.runs import SabotagedPair, SabotagedRun, ScoreCase, ScoredFigure
from sightline.evaluation.score.sabotage import SABOTAGES

SEEDS = (901, 902)


def pair(name, *broken, unchanged=False):
    cases = [ScoreCase("static", 50.0, 0.1, seed, None, sabotage=name) for seed in SEEDS]
    runs = tuple(SabotagedRun(case, names, 1.0, unchanged) for case, names in zip(cases, broken, strict=True))
    return SabotagedPair(f"static {name}", "static", name, runs)


def page(changed, healthy_ok=True):
    pairs = [pair(name, ("acquired_s",), ("acquired_s", "found_s")) for name in SABOTAGES if name != changed.sabotage]
    figure = ScoredFigure("static +50 ms 10% loss", "bearing_rms_deg", 0.1, 0.2, "deg", 0.5, healthy_ok)
    return "\n".join(page_lines([figure], [*pairs, changed], ["static"], SEEDS))


def row(text):
    return next(line for line in text.splitlines() if line.startswith("| static |"))


def test_cell_names_the_first_broken_bound_of_each_run():
    assert row(page(pair("range-blind", ("found_s",), ("wall_contacts",)))) == (
        f"| static | ok | {' | '.join(['acquired_s'] * 9)} | found_s, wall_contacts |")


def test_run_that_passes_and_a_healthy_run_that_fails_stand_out():
    text = row(page(pair("range-blind", ("found_s",), ()), healthy_ok=False))
    assert "| **bearing_rms_deg** |" in text and "| **1 of 2 pass** found_s |" in text


def test_pair_without_effect_has_its_reason_below_the_table(monkeypatch):
    monkeypatch.setattr(sabotage, "UNAFFECTED", {"range-blind": ("nothing is near", frozenset({"static"}))})
    text = page(pair("range-blind", (), (), unchanged=True))
    assert row(text).endswith("| unchanged (1) |")
    assert text.splitlines()[-1] == "1. The run equals the healthy run byte for byte: nothing is near."
    assert "python -m docs.make.sabotage --seeds 901,902 --scenario static`" in text


@pytest.mark.parametrize("name", SABOTAGES)
def test_every_sabotage_has_its_meaning_on_the_page(name):
    assert f"| `{name}` | {MEANINGS[name]} |" in page(pair("range-blind", ("found_s",), ("found_s",)))
