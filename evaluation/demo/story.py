"""The story of two runs: events, figures from the motor log, captions and the order of scenes. Pure.

`Take` holds the records of one run. `scenes` cuts two takes into a film, `shot` describes one image of it.
Every speed, time and distance comes from the motor log. The age bar alone uses the time stamps of the frames.
"""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, Literal, NamedTuple

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.evidence import DISTANCE_M, ZERO_MS, MotorRow, measure_stop, wheel_mps
from sightline.protocol.errors import CheckError
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.sim.truth import Truth

Event = Literal["moving", "wifi lost", "wifi back", "vision killed", "vision back", "STOP", "wall", "end"]
Tone = Literal["calm", "lost", "safe", "bad"]

SAFE_NAME: Final = "Sightline"
NAIVE_NAME: Final = "Naive robot"
LIMITS: Final = SafetyConfig()
"""Default age limits of the robot."""
BEFORE_S: Final = 3.5
"""Time of following before the first event of a take."""
AFTER_S: Final = 2.9
"""Time shown after an event that leads to a stop."""
AGAIN_S: Final = 3.4
"""Time of following again."""
WALL_S: Final = 1.4
"""Time at the wall."""
LOST_AT_X_M: Final = 1.1
"""The radio is lost when the robot passes this on its way to the east wall ..."""
_FAST_MPS: Final = 0.3
"""... while its speed and its newest command are at least this fast ..."""
_TOWARD_RAD: Final = 0.5
"""... and its heading differs by at most this."""
_ALONGSIDE_S: Final = 0.6
"""Time before the vision service is killed."""
_NAIVE_BEFORE_S: Final = 2.4


class Arrival(NamedTuple):
    """A command that reached the robot, and the capture time of its frame."""

    t_us: int
    frame_us: int
    linear_mps: float


class Image(NamedTuple):
    """A frame of the robot, as JPEG."""

    t_us: int
    jpeg: bytes


class StateAt(NamedTuple):
    """The state that the robot published."""

    t_us: int
    state: str


@dataclass(slots=True)
class Take:
    """The records of one run, on the robot's clock, each list in order of time."""

    name: str
    truths: list[Truth] = field(default_factory=list)
    images: list[Image] = field(default_factory=list)
    arrivals: list[Arrival] = field(default_factory=list)
    states: list[StateAt] = field(default_factory=list)
    motors: list[MotorRow] = field(default_factory=list)
    events: dict[Event, int] = field(default_factory=dict)


class StopFigure(NamedTuple):
    """Time and distance from an event until the wheels are at zero, by the motor log."""

    ms: float
    m: float

    @property
    def text(self) -> str:
        """Format in milliseconds and centimeters."""
        return f"{self.ms:.0f} ms, {100 * self.m:.0f} cm"


def stop_after(take: Take, event: Event, until: Event) -> StopFigure:
    """Measure the stop after `event`. Raises CheckError if the wheels were not at zero before `until`."""
    stop = measure_stop(take.motors, take.events[event], take.events[until])
    if stop.zero_ms is None:
        raise CheckError(f"{take.name}: the wheels were not at zero between {event!r} and {until!r}; run it again")
    return StopFigure(stop.zero_ms, stop.distance_m)


def driven_m(take: Take, since_us: int, until_us: int) -> float:
    """Return the distance that the wheels rolled between two times, m."""
    return measure_stop(take.motors, since_us, until_us).distance_m


def wall_us(truths: Sequence[Truth], since_us: int) -> int | None:
    """Return when the robot first touched a wall after `since_us`; None if it never did."""
    return next((now.t_us for before, now in pairwise(truths)
                 if now.t_us > since_us and now.wall_contacts > before.wall_contacts), None)


@dataclass(frozen=True, slots=True)
class Story:
    """Both takes with their figures."""

    safe: Take
    naive: Take
    wifi: StopFigure
    vision: StopFigure
    stop: StopFigure
    naive_m: float
    """Distance from the loss of the radio to the wall."""
    naive_ms: float
    naive_mps: float
    """Commanded wheel speed of the naive robot at the wall."""

    @property
    def checks(self) -> list[Check]:
        """Return the claims of the film with their bounds."""
        stops = (("Wi-Fi lost", self.wifi), ("vision killed", self.vision), ("STOP", self.stop))
        checks = [at_most(f"{name}: wheels at zero", figure.ms, "ms", ZERO_MS) for name, figure in stops]
        checks += [at_most(f"{name}: distance", figure.m, "m", DISTANCE_M) for name, figure in stops]
        hits = sum(now.wall_contacts for now in self.safe.truths[-1:])
        checks.append(at_most("wall contacts of Sightline", hits, "steps", 0.0))
        return [*checks, at_least("distance of the naive robot", self.naive_m, "m", DISTANCE_M)]


def heads_for_wall(now: Truth, arrivals: Sequence[Arrival]) -> bool:
    """Return True if a robot that keeps its newest command hits the east wall within the outage: it drives fast
    toward it, and its newest command is as fast. On a busy machine the two differ.
    """
    is_on_the_way = now.x_m >= LOST_AT_X_M and abs(now.yaw_rad) < _TOWARD_RAD and now.linear_mps >= _FAST_MPS
    return is_on_the_way and has_fast_command(arrivals)


def has_fast_command(arrivals: Sequence[Arrival]) -> bool:
    """Return True if the newest command is to drive fast."""
    return bool(arrivals) and arrivals[-1].linear_mps >= _FAST_MPS


def compose(safe: Take, naive: Take) -> Story:
    """Compute the figures of both takes. Raises CheckError if one of them did not end as the film shows."""
    lost_us = naive.events["wifi lost"]
    if "wall" not in naive.events:
        raise CheckError("the naive robot met no wall while the radio was gone, as its last command was slow; "
                             "run it again on a machine with less load")
    hit_us = naive.events["wall"]
    return Story(
        safe, naive, stop_after(safe, "wifi lost", "wifi back"), stop_after(safe, "vision killed", "vision back"),
        stop_after(safe, "STOP", "end"), driven_m(naive, lost_us, hit_us), (hit_us - lost_us) / 1000,
        speed_mps(naive.motors, hit_us),
    )


def speed_mps(motors: Sequence[MotorRow], t_us: int) -> float:
    """Return the commanded speed of the faster wheel at `t_us`; 0 before the first command."""
    index = bisect_right(motors, t_us, key=lambda row: row.t_us)
    return wheel_mps(motors[index - 1]) if index else 0.0


def age_us(arrivals: Sequence[Arrival], t_us: int) -> int | None:
    """Return the age at `t_us` of the newest frame behind any command that had arrived; None before the first."""
    newest = max((one.frame_us for one in arrivals[: bisect_right(arrivals, t_us, key=lambda one: one.t_us)]),
                 default=None)
    return None if newest is None else max(0, t_us - newest)


# --- the film --------------------------------------------------------------------------------------------------------


class FilmScene(NamedTuple):
    """A part of one take in real time."""

    take: Take
    from_us: int
    to_us: int

    def times_us(self, fps: float) -> list[int]:
        """Return the times of its images."""
        return [self.from_us + round(number * 1e6 / fps)
                for number in range(round((self.to_us - self.from_us) * fps / 1e6))]


def scenes(story: Story) -> list[FilmScene]:
    """Cut both takes. Waiting times are left out."""
    safe, naive = story.safe.events, story.naive.events
    return [
        FilmScene(story.safe, safe["wifi lost"] - _us(BEFORE_S), safe["wifi lost"] + _us(AFTER_S)),
        FilmScene(story.safe, safe["wifi back"], safe["wifi back"] + _us(AGAIN_S)),
        FilmScene(story.safe, safe["vision killed"] - _us(_ALONGSIDE_S), safe["vision killed"] + _us(AFTER_S)),
        FilmScene(story.safe, safe["STOP"] - _us(AGAIN_S / 2), safe["STOP"] + _us(AFTER_S - 0.4)),
        FilmScene(story.naive, naive["wifi lost"] - _us(_NAIVE_BEFORE_S), naive["wall"] + _us(WALL_S)),
    ]


def _us(seconds: float) -> int:
    return round(seconds * 1e6)


@dataclass(frozen=True, slots=True)
class FilmShot:
    """The content of one image of the film next to the two views."""

    name: str
    caption: str
    tone: Tone
    state: str
    speed_mps: float
    age_us: int | None
    wifi: bool
    vision: bool


def shot(story: Story, take: Take, t_us: int) -> FilmShot:
    """Describe the image of `take` at `t_us`."""
    is_safe = take is story.safe
    caption, tone = _safe_caption(story, t_us) if is_safe else _naive_caption(story, t_us)
    return FilmShot(
        take.name, caption, tone, state_at(take.states, t_us) if is_safe else "no gate",
        speed_mps(take.motors, t_us), age_us(take.arrivals, t_us),
        wifi=not _between(take.events, t_us, "wifi lost", "wifi back"),
        vision=not _between(take.events, t_us, "vision killed", "vision back"),
    )


def state_at(states: Sequence[StateAt], t_us: int) -> str:
    """Return the newest state published by `t_us`, or "" before the first."""
    index = bisect_right(states, t_us, key=lambda one: one.t_us)
    return states[index - 1].state if index else ""


def _between(events: Mapping[Event, int], t_us: int, begin: Event, end: Event) -> bool:
    return begin in events and events[begin] <= t_us and (end not in events or t_us < events[end])


def _safe_caption(story: Story, t_us: int) -> tuple[str, Tone]:
    """Return the caption of the last event by `t_us`, after a stop with its figures."""
    events = story.safe.events
    if t_us < events["wifi lost"]:
        return "A vision service steers the robot over Wi-Fi.", "calm"
    if t_us < events["wifi back"]:
        return _stopping(t_us - events["wifi lost"], story.wifi, "Wi-Fi lost")
    if t_us < events["vision killed"]:
        return "Wi-Fi is back. The robot follows again.", "calm"
    if t_us < events["vision back"]:
        return _stopping(t_us - events["vision killed"], story.vision, "Vision service killed")
    if t_us < events["STOP"]:
        return "The vision service is back. The robot follows again.", "calm"
    return _stopping(t_us - events["STOP"], story.stop, "Operator: STOP")


def _stopping(since_us: int, figure: StopFigure, cause: str) -> tuple[str, Tone]:
    if since_us < figure.ms * 1000:
        return cause, "lost"
    return f"{cause}. Wheels at zero after {figure.text}.", "safe"


def _naive_caption(story: Story, t_us: int) -> tuple[str, Tone]:
    lost_us, hit_us = story.naive.events["wifi lost"], story.naive.events["wall"]
    if t_us < lost_us:
        return "Same scene, a naive robot: it repeats its last command.", "calm"
    if t_us < hit_us:
        on_cm = 100 * driven_m(story.naive, lost_us, t_us)
        return f"Wi-Fi lost. It drives on: {on_cm:.0f} cm", "lost"
    return f"Into the wall after {100 * story.naive_m:.0f} cm. Wheels at {story.naive_mps:.2f} m/s.", "bad"


def closing_lines(story: Story) -> list[tuple[str, str, Tone]]:
    """Return the lines of the last image: event, figure, color."""
    return [
        ("Wi-Fi lost", f"stops after {story.wifi.text}", "safe"),
        ("Vision service killed", f"stops after {story.vision.text}", "safe"),
        ("Operator: STOP", f"stops after {story.stop.text}", "safe"),
        ("Naive robot, Wi-Fi lost", f"into the wall after {100 * story.naive_m:.0f} cm", "bad"),
    ]
