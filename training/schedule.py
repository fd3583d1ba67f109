"""Set learning rate, scenes and crops by step, which decide the result of a training. Pure."""

import math
from dataclasses import dataclass
from typing import Final

_WARM_UP: Final = 100
"""Steps, at the start of each round."""
_LEAST_RATE: Final = 0.01
"""Learning rate at the end of a round, as a share of its highest."""
LEAST_SHARE: Final = 1 / 4
"""Least peak rate of a round, as a share of the first round's: that of the third. The shipped model had an
eighth in rounds four and five, and a quarter in the sixth, which made the network smaller.
"""
START_SHARE: Final = 0.2
"""Share of the initial model in the final weights. With 0.4 the training over photographs finds fewer small balls
there, and with 0 it takes more drawn things for balls.
"""
WHOLE_FROM: Final = 0.8
"""Fraction of a round from which whole images replace cut-outs."""


_HARDER_FROM: Final = 2
"""This round and later ones, counted from 0, use harder images."""


@dataclass(frozen=True, slots=True)
class SceneRange:
    """Range of scenes of a step: the first `known`, of which those from `newest` on are new in its round."""

    newest: int
    known: int
    harder: bool = False
    """True to show newer scenes, distractors and bad images more often than by chance."""


@dataclass(frozen=True, slots=True)
class Training:
    """The training settings in the model card."""

    rounds: tuple[int, ...]
    """Steps of each. In a round the learning rate rises and falls, with half the peak of the round before but
    no less than `LEAST_SHARE`, and the number of scenes grows by the same amount."""
    batch: int = 32
    rate: float = 3e-3
    decay: float = 1e-4
    seed: int = 1
    jobs: int = 1
    """Processes that share each batch. A GPU computes the whole batch."""
    start: str = ""
    """SHA-256 of the initial model of the last round, if the earlier rounds were not of this training."""

    @property
    def steps(self) -> int:
        """Return the number of steps of all rounds."""
        return sum(self.rounds)

    @property
    def last_from(self) -> int:
        """Return the first step of the last round."""
        return self.steps - self.rounds[-1]

    def rate_at(self, step: int) -> float:
        """Return the share of `rate` at a step. In each round it rises, then falls along a cosine."""
        number, within, steps = self._place(step)
        highest = max(LEAST_SHARE, 0.5**number)
        if within < _WARM_UP:
            return highest * (within + 1) / _WARM_UP
        done = min(1.0, (within - _WARM_UP) / max(1, steps - _WARM_UP))
        return highest * (_LEAST_RATE + (1 - _LEAST_RATE) * 0.5 * (1 + math.cos(math.pi * done)))

    def shown_at(self, step: int, scenes: int) -> SceneRange:
        """Return the range of scenes for a step."""
        number = self._place(step)[0]
        known = max(1, scenes * (number + 1) // len(self.rounds))
        return SceneRange(min(known - 1, scenes * number // len(self.rounds)), known, number >= _HARDER_FROM)

    def whole_at(self, step: int) -> bool:
        """Return True if the step uses whole images, half as many."""
        _, within, steps = self._place(step)
        return within >= WHOLE_FROM * steps

    def _place(self, step: int) -> tuple[int, int, int]:
        """Return the round, the step in it, its number of steps; after the last step, the end of the last round."""
        begin = 0
        for number, steps in enumerate(self.rounds[:-1]):
            if step < begin + steps:
                return number, step - begin, steps
            begin += steps
        return len(self.rounds) - 1, step - begin, self.rounds[-1]
