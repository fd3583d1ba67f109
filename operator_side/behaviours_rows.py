"""What stands on docs/behaviours.md, in its order: scenarios, their laws, the light they are seen in. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from operator_side.score_runs import Case
from sim.scenario import load_scenario

LATENCY_MS, LOSS = 50.0, 0.1
LOOKS: Final = ("dim", "bright", "warm", "desaturated", "quality30")
"""The light in which a traffic light must be read, beside the ordinary."""


@dataclass(frozen=True, slots=True)
class Row:
    """One behaviour: a scenario, and a law in place of its own if it is a baseline's."""

    scenario: str
    baseline: str = ""
    robot: str | None = None
    looks: tuple[str, ...] = ()
    """In what other light it is run too."""

    @property
    def law(self) -> str:
        """The mission that drives."""
        return self.baseline or load_scenario(self.scenario).mission

    @property
    def title(self) -> str:
        """Its heading."""
        extra = f", baseline `{self.baseline}`" if self.baseline else ""
        return self.scenario + (f", robot `{self.robot}`" if self.robot else "") + extra

    @property
    def anchor(self) -> str:
        """What a link within the page calls that heading."""
        return self.title.replace("`", "").replace(",", "").replace(" ", "-")

    @property
    def default(self) -> "Row":
        """What a baseline is compared with."""
        return Row(self.scenario, "", self.robot)

    def cases(self, seeds: Sequence[int], look: str | None = None) -> list[Case]:
        """Its runs in one light, the scenario's own if None."""
        mission = self.baseline or None
        return [Case(self.scenario, LATENCY_MS, LOSS, seed, None, mission, self.robot, look) for seed in seeds]

    def all_cases(self, seeds: Sequence[int]) -> list[Case]:
        """Its runs in every light."""
        return [case for look in (None, *self.looks) for case in self.cases(seeds, look)]


ROWS: Final = (
    Row("blue-sphere"), Row("blue-sphere", "band"), Row("blue-sphere-eight"),
    Row("ball"), Row("ball", "pixel-pi"), Row("ball-eight"),
    Row("blocks"), Row("blocks-red"), Row("blocks-yellow"), Row("blocks", "pixel-pi"), Row("blocks-eight"),
    Row("chaser"), Row("chaser", robot="chaser"), Row("chaser", "pixel-p"), Row("chaser-circle"), Row("chaser-eight"),
    Row("legs-slow"), Row("legs"), Row("legs-fast"), Row("legs-crowd"), Row("legs", "legs-baseline"),
    Row("traffic-light", looks=LOOKS), Row("traffic-light-boxes", looks=LOOKS),
    Row("thymio"), Row("thymio-box"), Row("thymio-slalom"), Row("thymio-trap"), Row("thymio-closed"),
    Row("thymio", "goto-baseline"), Row("thymio-trap", "goto-baseline"),
    Row("occluder"),
)  # fmt: skip

CHARACTER: Final = {
    "band": "Its forward band is 60 % of the picture wide, so it hardly ever turns before the ball leaves the picture; "
    "then it stands.",
    "pixel-pi": "A speed of 200 / area and a sum of all corrections, per frame, without clamps: pixels are no metres, "
    "and the sum has no end.",
    "pixel-p": "It decides five times a second, in pixels, with a speed for near the middle and one for elsewhere: it "
    "knows no distance and overshoots.",
    "legs-baseline": "A sum of errors without time and clamp, and a field that is not the same to the left and to the "
    "right.",
    "goto-baseline": "Two laws that never act together and a machine of three states without a memory: it turns by the "
    "clock, and cannot say that there is no way.",
}
"""What an older law is like, and why it fails where it does."""
