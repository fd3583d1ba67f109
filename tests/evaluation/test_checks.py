"""Figures and checks as people read them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.evaluation.checks import Check, check_lines, number


@pytest.mark.parametrize(("value", "text"), [
    (None, "never"), (0.0, "0"), (0.58213, "0.582"), (12.34, "12.3"), (999.4, "999"), (999.6, "1000"), (1048.7, "1049"),
    (2570.0, "2570"), (-2570.4, "-2570"), (1e6, "1000000"), (float("inf"), "inf"),
])
def test_a_figure_has_three_digits_and_no_exponent(value, text):
    assert number(value) == text


@given(st.floats(min_value=-1e9, max_value=1e9).filter(lambda value: value == 0 or abs(value) > 1e-3))
def test_what_is_shown_is_what_it_is_within_half_a_percent(value):
    assert "e" not in number(value) and float(number(value)) == pytest.approx(value, rel=5.1e-3)


def test_check_names_its_figure_value_and_result():
    (line,) = check_lines([Check("step", 1048.7, "us", 800.0, ok=False)])
    assert line.split() == ["step", "1049", "us", "bound", "800", "FAIL"]


def test_a_failed_value_that_three_digits_round_to_its_bound_has_more_digits():
    near, equal = Check("share", 94.96, "%", 95.0, ok=False), Check("share", 95.0, "%", 95.0, ok=True)
    assert [line.split()[1] for line in check_lines([near, equal])] == ["94.96", "95"]
