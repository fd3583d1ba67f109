"""What stands on docs/behaviours.md, in its order: scenarios, their laws, the light they are seen in. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sightline.evaluation.score.runs import Case
from sightline.sim.scenario import load_scenario

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
    "band": "Straight on at 0.1 m/s, and no turn before the ball is 30 % of the picture's width off the middle. The "
    "ball is quicker: soon it looks too small for the band, so the robot stands, and the ball leaves the picture.",
    "pixel-pi": "It does not turn within 20 pixels of the middle, so the target hangs some degrees to one side and "
    "swings there, ever more as the sum of all corrections grows. And 200 / area is a speed for one distance: the one "
    "at which it happens to be the target's.",
    "pixel-p": "It decides five times a second, by pixels: forward until the ball's radius is 50 of them, then not at "
    "all. So it keeps another distance than it should, by runs and stops; to a ball that rolls straight ahead it "
    "points well.",
    "legs-baseline": "Sums of errors without time and clamp, and a field that is not the same to the left and to the "
    "right: the person swings from edge to edge of the picture, and out of it.",
    "goto-baseline": "Its sensors reach 0.2 m, it comes at up to 0.5 m/s and turns by the clock. With this delay it is "
    "so near when it turns that the range guard lets no corner come nearer; it never backs away, and cannot say that "
    "there is no way. With none it goes round the cylinder.",
}
"""What an older law is like, and why it fails where it does."""
