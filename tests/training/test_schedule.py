"""Values that change during a training."""

import pytest

from sightline.training.schedule import LEAST_SHARE, WHOLE_FROM, SceneRange, Training


@pytest.mark.parametrize("rounds", [(1000,), (1000, 600), (300, 1000, 500), (300, 400, 500, 600, 700)])
def test_each_round_has_the_rate_up_and_down_again_half_as_high_but_not_below_a_quarter(rounds):
    training, begin = Training(rounds), 0
    for steps, highest in zip(rounds, [1, 0.5, 0.25, LEAST_SHARE, LEAST_SHARE], strict=False):
        rates = [training.rate_at(step) for step in range(begin, begin + steps)]
        top = rates.index(max(rates))
        assert max(rates) == pytest.approx(highest) and 90 <= top <= 101
        assert rates[: top + 1] == sorted(rates[: top + 1]) and rates[top:] == sorted(rates[top:], reverse=True)
        assert 0 < rates[0] < 0.02 * highest and 0 < rates[-1] < 0.02 * highest
        begin += steps
    assert 0 < training.rate_at(training.steps) < 0.02, "the optimizer requests one more than there are"


@pytest.mark.parametrize(("rounds", "known"), [((10,), [40]), ((10, 5), [20, 40]), ((3, 4, 5), [13, 26, 40])])
def test_each_round_takes_in_more_scenes_and_the_last_all(rounds, known):
    training, begin, before = Training(rounds), 0, 0
    for number, (steps, expected) in enumerate(zip(rounds, known, strict=True)):
        shown = SceneRange(before, expected, harder=number >= 2)
        assert {training.shown_at(step, 40) for step in range(begin, begin + steps)} == {shown}
        begin, before = begin + steps, expected
    assert training.steps == sum(rounds) and training.shown_at(0, 1) == SceneRange(0, 1)
    for step in range(training.steps):
        few = training.shown_at(step, 1)
        assert 0 <= few.newest < few.known == 1, "a single scene is shown in every round"


def test_each_round_ends_with_whole_pictures():
    training = Training((100, 50))
    whole = [training.whole_at(step) for step in range(150)]
    assert whole == [number % 100 >= WHOLE_FROM * (100 if number < 100 else 50) for number in range(150)]
