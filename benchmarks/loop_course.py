"""What became of the pictures of one sample: how many were captured, how many answered, and how late. Pure."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

Header = tuple[int, int, int | None]
"""Of a frame: (seq, t_us, latency_us of the command accepted last before it)."""
Accepted = tuple[int, int]
"""Of a status: (t_us, commands accepted so far)."""


@dataclass(frozen=True, slots=True)
class Course:
    """`ages_us` are (time of the verdict or nearly, age of the picture at the verdict), in the order of time."""

    captured: int
    answered_percent: float
    ages_us: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Sample:
    """What was measured of `name` within `seconds`; processor time and memory are by process.

    `taken_percent` is the share of the machine's time that others had; `hot_us` one step without pauses (floor only);
    `carried_bytes` what went over the contestant's sockets, None where the kernel does not tell.
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


def joined(samples: Sequence[Sample]) -> Sample:
    """What was measured of one contestant in several turns, as one sample; memory and disturbance are the worst."""
    first, courses = samples[0], [sample.course for sample in samples]
    captured = sum(course.captured for course in courses)
    answered = sum(course.captured * course.answered_percent for course in courses) / max(1, captured)
    carried = [sample.carried_bytes for sample in samples]
    return replace(
        first,
        course=Course(captured, answered, tuple(age for course in courses for age in course.ages_us)),
        seconds=sum(sample.seconds for sample in samples),
        cpu_s={name: sum(sample.cpu_s[name] for sample in samples) for name in first.cpu_s},
        memory_mb={name: max(sample.memory_mb[name] for sample in samples) for name in first.memory_mb},
        carried_bytes=None if None in carried else sum(one or 0 for one in carried),
        taken_percent=max(sample.taken_percent for sample in samples),
        tries=sum(sample.tries for sample in samples),
    )


def course_of_tally(
    captured_us: Sequence[int], judged_us: Sequence[Sequence[int]], begin_us: int, end_us: int
) -> Course:
    """Of a contestant that noted everything itself.

    Ages are those of verdicts within the time, so that a growing queue shows; answered is what was captured within it
    and judged at all, late or not.
    """
    captured = {t_us for t_us in captured_us if begin_us <= t_us < end_us}
    answered = captured & {t_us for t_us, _ in judged_us}
    ages_us = tuple((at_us, at_us - t_us) for t_us, at_us in judged_us if begin_us <= at_us < end_us)
    return Course(len(captured), 100 * len(answered) / max(1, len(captured)), ages_us)


def course_of_headers(headers: Sequence[Header], accepted: Sequence[Accepted], begin_us: int, end_us: int) -> Course:
    """Of the services: ages as the driver measured them, carried by the next frame's header; accepted by its own count.

    A header whose latency is the one before it brings no news: nothing was accepted in between.
    """
    inside = [header for header in headers if begin_us <= header[1] < end_us]
    ages_us: list[tuple[int, int]] = []
    last_us: int | None = None
    for _, t_us, latency_us in inside:
        if latency_us is not None and latency_us != last_us:
            ages_us.append((t_us, latency_us))
        last_us = latency_us
    if not ages_us:
        return Course(0, 0.0, ())
    lag_us = round(median(age_us for _, age_us in ages_us))
    statuses = [status for status in accepted if begin_us <= status[0] < end_us]
    captured = inside[-1][0] - inside[0][0] + 1  # by number: those that never arrived count too
    return Course(captured, _accepted_percent(headers, statuses, lag_us), tuple(ages_us))


def _accepted_percent(headers: Sequence[Header], statuses: Sequence[Accepted], lag_us: int) -> float:
    """Share of the frames captured between the first and the last status; verdicts lag captures by `lag_us`."""
    times_us = [t_us for _, t_us, _ in headers]
    seqs = [headers[max(0, bisect_right(times_us, t_us - lag_us) - 1)][0] for t_us, _ in statuses]
    if len(statuses) < 2 or seqs[-1] == seqs[0]:
        return 0.0
    # A verdict on the very edge may be counted on its other side.
    return min(100.0, 100 * (statuses[-1][1] - statuses[0][1]) / (seqs[-1] - seqs[0]))
