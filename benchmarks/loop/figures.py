"""Settings, samples, figures and bounds of a race. Pure."""

from bisect import bisect_left, bisect_right
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.protocol.errors import ConfigError

OURS: Final = "sightline"
FLOOR: Final = "floor"
"""The pipeline at the pace of the images, in one process."""
OLDER: Final = "older"
"""The pipeline of the legacy articles, detector included. All others use Sightline's detector and steering."""
ZENOH: Final = ("callback", "ring", "newest")
PEERS: Final = ("tcp", *ZENOH, "openpi", "lekiwi", OLDER)
"""Designs that a user would build."""
MAX_FPS: Final = 240.0
"""Limit of the robot service."""
MAX_ANGULAR_RAD_S: Final = 8.0
"""Turn rate above all commands for these images, rad/s. At a limit, one command would equal the next."""
TAKEN_BOUND_PERCENT: Final = 5.0
"""Share of time of other programs above which a sample is inconclusive."""


@dataclass(frozen=True, slots=True)
class LoopSetting:
    """Settings of all contestants. `pictures` is a folder of JPEGs of the given size."""

    pictures: Path
    width_px: int = 640
    height_px: int = 480
    fps: float = 30.0
    transport: str = "zenoh"
    detector_delay_ms: float = 0.0
    """Additional time of every detector, as for an accelerator."""
    overload: float = 0.0
    """Ratio of offered to detectable images; 0 leaves the rate unchanged."""
    busy_ms: float = 0.0
    """Smallest time of every detector for an image, as on a slower processor; follows from `overload`."""
    seconds: float = 10.0
    peers: tuple[str, ...] = PEERS
    tries: int = 3
    """Most samples that are taken in place of disturbed ones."""

    def __post_init__(self) -> None:
        """Raise ConfigError for settings that cannot run."""
        if not 1 <= self.fps <= MAX_FPS or not 2 <= self.seconds <= 600 or not 0 <= self.detector_delay_ms <= 300:
            raise ConfigError("--fps 1 to 240, --seconds 2 to 600 and --detector-delay-ms 0 to 300, e.g. --fps 30")
        if self.overload and (not 1 < self.overload <= 10 or self.detector_delay_ms):
            raise ConfigError("--overload is above 1, at most 10, and without --detector-delay-ms, e.g. --overload 2")
        if not 64 <= self.width_px <= 1920 or not 64 <= self.height_px <= 1080:
            raise ConfigError(f"--size {self.width_px}x{self.height_px}: 64x64 to 1920x1080")

    @property
    def is_loaded(self) -> bool:
        """Return True if more images arrive than the detector can process."""
        return self.overload > 1 or self.detector_delay_ms > 1000 / self.fps

    @property
    def contestants(self) -> tuple[str, ...]:
        """Return the contestants in order."""
        return (FLOOR, OURS, *self.peers)


def size_of(text: str) -> tuple[int, int]:
    """Parse `640x480` as (width, height). Raises ConfigError for other text."""
    width, cross, height = text.partition("x")
    if not cross or not (width + height).isascii() or not width.isdigit() or not height.isdigit():
        raise ConfigError(f"--size {text!r}: write WIDTHxHEIGHT, e.g. 640x480")
    return int(width), int(height)


def peers_of(text: str) -> tuple[str, ...]:
    """Parse `all`, `none`, or names separated by commas. Raises ConfigError for a name that is not in `PEERS`."""
    if text in ("all", "none"):
        return PEERS if text == "all" else ()
    names = tuple(text.split(","))
    unknown = [name for name in names if name not in PEERS]
    if unknown:
        raise ConfigError(f"--peers {unknown[0]!r}: all, none, or of {', '.join(PEERS)}")
    return names


# The outcome of the images of one sample: counts of captured and answered ones, and the ages. Pure.


Header = tuple[int, int, int | None]
"""Of a frame: (seq, t_us, latency_us of the last command accepted before it)."""
Accepted = tuple[int, int]
"""Of a status: (t_us, number of accepted commands). A command sent twice is accepted twice."""


@dataclass(frozen=True, slots=True)
class Course:
    """Results of one contestant. `ages_us` are (time of the result, age of the image then), in order.

    The result of the services is the first `drive.set` with other speeds after the validation of a command;
    `validated_us` are the ages at the validation. A peer has no wheels: its result is the command in its robot process.
    """

    captured: int
    answered_percent: float
    ages_us: tuple[tuple[int, int], ...]
    validated_us: tuple[int, ...] = ()

    def fps(self, seconds: float) -> float:
        """Return the answered images per second."""
        return self.captured * self.answered_percent / 100 / seconds


@dataclass(frozen=True, slots=True)
class LoopSample:
    """The measurements of `name` within `seconds`. Processor time and memory are per process.

    `taken_percent` is the share of time that other programs had; `hot_us` is one step without pauses (floor only);
    `carried_bytes` are the bytes on the contestant's sockets, None without kernel support.
    """

    name: str
    course: Course
    seconds: float
    cpu_s: Mapping[str, float]
    memory_mb: Mapping[str, float]
    carried_bytes: int | None
    taken_percent: float
    hot_us: float | None = None
    tries: int = 1


def joined(samples: Sequence[LoopSample]) -> LoopSample:
    """Join several turns of one contestant into one sample. Memory and disturbance are the worst of them."""
    first, courses = samples[0], [sample.course for sample in samples]
    captured = sum(course.captured for course in courses)
    answered = sum(course.captured * course.answered_percent for course in courses) / max(1, captured)
    carried = [sample.carried_bytes for sample in samples]
    return replace(
        first,
        course=Course(captured, answered, tuple(age for course in courses for age in course.ages_us),
                      tuple(age for course in courses for age in course.validated_us)),
        seconds=sum(sample.seconds for sample in samples),
        cpu_s={name: sum(sample.cpu_s[name] for sample in samples) for name in first.cpu_s},
        memory_mb={name: max(sample.memory_mb[name] for sample in samples) for name in first.memory_mb},
        carried_bytes=None if None in carried else sum(one or 0 for one in carried),
        taken_percent=max(sample.taken_percent for sample in samples),
        tries=sum(sample.tries for sample in samples),
    )


def course_of_tally(
    captured_us: Sequence[int], commands_us: Sequence[Sequence[int]], begin_us: int, end_us: int
) -> Course:
    """Return the course of a contestant by its tally.

    Ages are of results within the period, so that a growing queue shows. An image captured within it counts as
    answered even if its result is late.
    """
    captured = {t_us for t_us in captured_us if begin_us <= t_us < end_us}
    answered = captured & {t_us for t_us, _ in commands_us}
    ages_us = tuple((at_us, at_us - t_us) for t_us, at_us in commands_us if begin_us <= at_us < end_us)
    return Course(len(captured), 100 * len(answered) / max(1, len(captured)), ages_us)


class WheelCommand(NamedTuple):
    """One line of the log drive."""

    t_us: int
    left_rad_s: float
    right_rad_s: float

    @property
    def moves(self) -> bool:
        """Return True if a wheel must turn."""
        return bool(self.left_rad_s or self.right_rad_s)


def read_wheel_commands(text: str) -> list[WheelCommand]:
    """Return the complete lines. A line that is still being written is left out."""
    parts = [line.split(",") for line in text.split("\n")[:-1]]
    return [WheelCommand(int(t), float(left), float(right)) for t, left, right in parts]


def changes_us(rows: Sequence[WheelCommand]) -> list[int]:
    """Return the times of the lines that change the speeds: only those carry a new command."""
    return [row.t_us for before, row in pairwise(rows) if row[1:] != before[1:]]


def repeats_us(commands: Sequence[tuple[int, str]]) -> set[int]:
    """Return the times of the images whose command equals the one before.

    `commands` are (time of the image, `linear|angular`), in order. A repeated command does not change the speeds, so
    the motor log does not show its time. The next change belongs to the next command.
    """
    return {t_us for (_, before), (t_us, command) in pairwise(commands) if command == before}


class WheelAge(NamedTuple):
    """Age of the image of an accepted command, at `drive.set` and at the validation."""

    set_us: int
    age_us: int
    validated_us: int


def wheel_ages(headers: Sequence[Header], sets_us: Sequence[int]) -> Iterator[WheelAge]:
    """Yield the ages of the accepted commands: from frame headers, and from the times of `drive.set`.

    A header contains the age of a frame at the last validation before it: of the newest frame that has this age then.
    If its latency equals the previous one, no command was accepted in between.
    """
    times_us = [t_us for _, t_us, _ in headers]
    for (_, _, before_us), (_, t_us, latency_us) in pairwise(headers):
        if latency_us is None or latency_us == before_us:
            continue
        frame = bisect_right(times_us, t_us - latency_us) - 1
        applied = bisect_left(sets_us, times_us[frame] + latency_us) if frame >= 0 else len(sets_us)
        if applied < len(sets_us):
            yield WheelAge(sets_us[applied], sets_us[applied] - times_us[frame], latency_us)


def course_of_headers(
    headers: Sequence[Header], accepted: Sequence[Accepted], sets_us: Sequence[int], begin_us: int, end_us: int,
    *, copies: float, repeated_us: Container[int] = (),
) -> Course:
    """Return the course of the services: ages at the wheels, and the driver's count of accepted commands.

    The vision service sent `copies` commands for each image, on average. The ages of `repeated_us` are unknown.
    """
    inside = [header for header in headers if begin_us <= header[1] < end_us]
    ages = [age for age in wheel_ages(headers, sets_us)
            if begin_us <= age.set_us < end_us and age.set_us - age.age_us not in repeated_us]
    if not ages or not inside:
        return Course(0, 0.0, ())
    lag_us = round(median(age.validated_us for age in ages))
    statuses = [status for status in accepted if begin_us <= status[0] < end_us]
    captured = inside[-1][0] - inside[0][0] + 1  # by number, so that lost frames count too
    return Course(captured, min(100.0, _accepted_percent(headers, statuses, lag_us) / copies),
                  tuple((age.set_us, age.age_us) for age in ages), tuple(age.validated_us for age in ages))


def _accepted_percent(headers: Sequence[Header], statuses: Sequence[Accepted], lag_us: int) -> float:
    """Return the commands per hundred frames captured between the first and the last status.

    Results lag captures by `lag_us`. A result near a boundary may count on either side.
    """
    times_us = [t_us for _, t_us, _ in headers]
    seqs = [headers[max(0, bisect_right(times_us, t_us - lag_us) - 1)][0] for t_us, _ in statuses]
    if len(statuses) < 2 or seqs[-1] == seqs[0]:
        return 0.0
    return 100 * (statuses[-1][1] - statuses[0][1]) / (seqs[-1] - seqs[0])


# The figures of `bench loop` and their bounds. Pure.


P50_OVER_FLOOR_MS: Final = 1.5
P95_OVER_FLOOR_MS: Final = 5.0
TIMES_FLOOR: Final = 1.5
BEHIND_ZENOH_MS: Final = 0.3
MOST_WAIT_MS: Final = 5.0
"""Wait of a command from its validation to `drive.set`."""
KNOWN_WAIT_SHARE: Final = 0.9
"""Share of the captured images whose command must have a known wait. Of two commands between two headers only one is
known; of one that repeats the command before, none.
"""
CPU_MS: Final = 1.5
"""CPU time per image of all processes of robot and vision service."""
CPU_OVER_FLOOR_MS: Final = 0.6
ANSWERED_PERCENT: Final = 99.0
"""Share of the captured images, and of those that the camera offers without overload."""
LOADED_FPS_SHARE: Final = 0.9
"""Share of the best rival without a queue. A queue may answer all images, but late."""
_QUEUES: Final = ("tcp", "callback")
OVERLOADED_LIKE_MS: Final = 80.0
"""With a detector overloaded by the rate, the permitted ages are those for a detector with this delay."""
TIMES_BEST: Final = 1.02
LOADED_P50_OVER_DELAY_MS: Final = 10.0
LOADED_P99_OVER_DELAY_MS: Final = 40.0
DRIFT_PERCENT: Final = 10.0
_WHOLE: Final = 0.99
"""Share of the requested seconds that a sample must have."""
_PART_US: Final = 10_000_000
_PARTS: Final = 5
"""Drift is from the first ten seconds to the last, or from the first fifth of a shorter time to its last."""


@dataclass(frozen=True, slots=True)
class LoopFigures:
    """One contestant. `answered_percent` is of the images that the camera offers, `accepted_percent` of the captured
    ones. Sightline captures only with credit, most rivals capture each image. Times are from capture to the result,
    `validated_ms` (median) to the validation of the services; `most_wait_ms` is the longest time between these two, of
    `commands` commands. None without an answer.

    `first_ms` and `last_ms` are medians of the first and the last ten seconds, or fifths of a shorter time; `cpu_ms` is
    per answered image and process, `memory_mb` the high-water mark, `bytes_per_picture` the bytes on the
    sockets, both ways.
    """

    name: str
    captured: int
    commands: int
    fps: float
    answered_percent: float
    accepted_percent: float
    p50_ms: float | None
    p95_ms: float | None
    p99_ms: float | None
    validated_ms: float | None
    most_wait_ms: float | None
    first_ms: float | None
    last_ms: float | None
    cpu_ms: Mapping[str, float]
    memory_mb: Mapping[str, float]
    bytes_per_picture: float | None
    taken_percent: float
    is_short: bool
    tries: int
    hot_ms: float | None

    @property
    def is_disturbed(self) -> bool:
        """Return True if other programs took too much of the machine's time, or left too little for the sample."""
        return self.taken_percent > TAKEN_BOUND_PERCENT or self.is_short


def percentile(values: Sequence[float], percent: float) -> float | None:
    """Return the smallest of `values` that at least `percent` (0..100) of them do not exceed, or None."""
    if not values:
        return None
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)  # rounded up
    return ordered[max(0, int(rank) - 1)]


def figures_of(sample: LoopSample, setting: LoopSetting) -> LoopFigures:
    """Compute the figures of a sample."""
    course, fps = sample.course, sample.course.fps(sample.seconds)
    ages_ms = [age_us / 1000 for _, age_us in course.ages_us]
    parts = _parts(course.ages_us)
    answers = max(1, len(ages_ms))
    return LoopFigures(
        name=sample.name,
        captured=course.captured,
        commands=len(ages_ms),
        fps=fps,
        answered_percent=100 * fps / setting.fps,
        accepted_percent=course.answered_percent,
        p50_ms=percentile(ages_ms, 50),
        p95_ms=percentile(ages_ms, 95),
        p99_ms=percentile(ages_ms, 99),
        validated_ms=percentile([age_us / 1000 for age_us in course.validated_us], 50),
        most_wait_ms=max((age_ms - us / 1000 for age_ms, us in zip(ages_ms, course.validated_us, strict=False)),
                         default=None),
        first_ms=parts[0],
        last_ms=parts[1],
        cpu_ms={name: 1000 * cpu_s / answers for name, cpu_s in sample.cpu_s.items()},
        memory_mb=dict(sample.memory_mb),
        bytes_per_picture=None if sample.carried_bytes is None else sample.carried_bytes / max(1, course.captured),
        taken_percent=sample.taken_percent,
        is_short=sample.seconds < _WHOLE * setting.seconds,
        tries=sample.tries,
        hot_ms=None if sample.hot_us is None else sample.hot_us / 1000,
    )


def _parts(ages_us: Sequence[tuple[int, int]]) -> tuple[float | None, float | None]:
    """Return the medians of the first and of the last part of the time, ms."""
    if not ages_us:
        return None, None
    begin_us, end_us = ages_us[0][0], ages_us[-1][0]
    part_us = min(_PART_US, (end_us - begin_us) / _PARTS)
    first = [age_us for at_us, age_us in ages_us if at_us <= begin_us + part_us]
    last = [age_us for at_us, age_us in ages_us if at_us >= end_us - part_us]
    return median(first) / 1000, median(last) / 1000


def loop_checks(figures: Mapping[str, LoopFigures], setting: LoopSetting) -> list[Check]:
    """Check Sightline against the floor and the rivals of the same run, or against the delay of a slow detector.

    `figures` has at least the floor and Sightline.
    """
    ours, floor = figures[OURS], figures[FLOOR]
    rivals = [figures[name] for name in PEERS if name in figures]
    like_ms = setting.detector_delay_ms or OVERLOADED_LIKE_MS
    checks = list(_loaded(ours, like_ms, rivals) if setting.is_loaded else _unloaded(ours, floor, rivals))
    least_fps = _least_fps(setting, rivals)
    if least_fps is not None:
        checks.append(at_least("answered per second", ours.fps, "", least_fps))
    for rival in rivals:
        checks.append(at_most(f"p95 behind {rival.name}", _over(ours.p95_ms, rival.p95_ms), "ms", 0.0))
        if not setting.is_loaded:
            checks.append(at_most(f"p99 behind {rival.name}", _over(ours.p99_ms, rival.p99_ms), "ms", 0.0))
    disturbed = [one for one in figures.values() if one.is_disturbed]
    return [*checks, at_most("samples disturbed by others", len(disturbed), "", 0.0)]


def _least_fps(setting: LoopSetting, rivals: Sequence[LoopFigures]) -> float | None:
    if not setting.is_loaded:
        return ANSWERED_PERCENT / 100 * setting.fps
    return max((LOADED_FPS_SHARE * one.fps for one in rivals if one.name not in _QUEUES), default=None)


def _unloaded(ours: LoopFigures, floor: LoopFigures, rivals: Sequence[LoopFigures]) -> Iterator[Check]:
    yield at_most("p50, times the floor", _times(ours.p50_ms, floor.p50_ms), "x", TIMES_FLOOR)
    yield at_most("p50 over floor", _over(ours.p50_ms, floor.p50_ms), "ms", P50_OVER_FLOOR_MS)
    yield at_most("p95 over floor", _over(ours.p95_ms, floor.p95_ms), "ms", P95_OVER_FLOOR_MS)
    best_ms = min((one.p50_ms for one in rivals if one.name in ZENOH and one.p50_ms is not None), default=None)
    if best_ms is not None:
        yield at_most("p50 behind the fastest over Zenoh", _over(ours.p50_ms, best_ms), "ms", BEHIND_ZENOH_MS)
    yield at_most("longest wait for the wheels", ours.most_wait_ms, "ms", MOST_WAIT_MS)
    yield at_least("commands with a known wait", ours.commands, "", KNOWN_WAIT_SHARE * ours.captured)
    yield at_most("not accepted", 100 - ours.accepted_percent, "%", 100 - ANSWERED_PERCENT)
    vision_ms = ours.cpu_ms["vision"]
    yield at_most("robot CPU", sum(ours.cpu_ms.values()) - vision_ms, "ms", CPU_MS)
    yield at_most("vision CPU", vision_ms, "ms", CPU_MS)
    yield at_most("vision CPU over floor", vision_ms - floor.cpu_ms["vision"], "ms", CPU_OVER_FLOOR_MS)


def _loaded(ours: LoopFigures, delay_ms: float, rivals: Sequence[LoopFigures]) -> Iterator[Check]:
    drift = _over(ours.last_ms, ours.first_ms)
    drift_percent = None if drift is None or not ours.first_ms else 100 * abs(drift) / ours.first_ms
    best_ms = min((one.p50_ms for one in rivals if one.p50_ms is not None), default=None)
    if best_ms is not None:
        yield at_most("p50, times the best rival", _times(ours.p50_ms, best_ms), "x", TIMES_BEST)
    yield at_most("age p50", ours.p50_ms, "ms", delay_ms + LOADED_P50_OVER_DELAY_MS)
    yield at_most("age p99", ours.p99_ms, "ms", delay_ms + LOADED_P99_OVER_DELAY_MS)
    yield at_most("drift of age", drift_percent, "%", DRIFT_PERCENT)
    yield at_most("not accepted", 100 - ours.accepted_percent, "%", 100 - ANSWERED_PERCENT)


def _times(value: float | None, other: float | None) -> float | None:
    return None if value is None or not other else value / other


def _over(value: float | None, other: float | None) -> float | None:
    return None if value is None or other is None else value - other
