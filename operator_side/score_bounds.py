"""What is demanded of each scenario, and whether a run keeps it. Pure.

For 0 to 200 ms added latency and 10 % loss on each leg. No contact is demanded everywhere but where it says how much.
"""

from sightline.evaluation.checks import Check
from sightline.evaluation.score.figures import AT_LEAST, Score

UNITS = {
    "acquired_s": "s", "found_s": "s", "bearing_rms_deg": "deg", "distance_rms_m": "m", "lost_percent": "%",
    "wall_contacts": "steps", "target_contacts": "steps", "travelled_m": "m", "wall_contact_s": "s",
    "least_distance_m": "m", "most_distance_m": "m", "least_ever_m": "m", "reached_s": "s", "least_clearance_m": "m",
    "given_up_s": "s", "crossed_on_red": "times", "crossed_late": "times", "least_crossings": "times",
    "start_s": "s", "wrong_states_percent": "%",
}
STANDS_STILL_FROM_MS = 350
"""With so much added latency no frame is young enough any more: the robot is to stand still, and that is judged."""

_CIRCLE = {"bearing_rms_deg": 1.0, "lost_percent": 0.0, "target_contacts": 0.0}
_EIGHT = {"bearing_rms_deg": 3.0, "lost_percent": 0.0, "target_contacts": 0.0}
_LEGS = {
    "bearing_rms_deg": 3.0, "lost_percent": 0.0, "least_distance_m": 0.7, "most_distance_m": 1.0, "least_ever_m": 0.3,
    "target_contacts": 0.0,
}
_LIGHT = {
    "crossed_on_red": 0.0, "crossed_late": 0.0, "least_crossings": 1.0, "start_s": 0.7, "wrong_states_percent": 0.0,
}
_COURSE = {"reached_s": 40.0, "least_clearance_m": 0.10}

BOUNDS: dict[str, dict[str, float]] = {
    "static": {"acquired_s": 1.5, "bearing_rms_deg": 0.5, "distance_rms_m": 0.03},
    "circle": {"bearing_rms_deg": 1.0, "distance_rms_m": 0.05},
    "eight": {"bearing_rms_deg": 3.0, "lost_percent": 0.0},
    "pushed": {"lost_percent": 0.0},
    "behind": {"found_s": 5.0},
    "walls": {},
    "occluder": {"wall_contact_s": 0.1},
    "blue-sphere": _CIRCLE, "ball": _CIRCLE, "blocks": _CIRCLE, "blocks-red": _CIRCLE, "blocks-yellow": _CIRCLE,
    "chaser": _CIRCLE, "chaser-circle": _CIRCLE,
    "blue-sphere-eight": _EIGHT, "ball-eight": _EIGHT, "blocks-eight": _EIGHT, "chaser-eight": _EIGHT,
    "legs": _LEGS, "legs-slow": _LEGS, "legs-fast": _LEGS, "legs-crowd": _LEGS,
    "traffic-light": _LIGHT, "traffic-light-boxes": _LIGHT,
    "thymio": {**_COURSE, "reached_s": 15.0}, "thymio-box": _COURSE, "thymio-slalom": _COURSE,
    "thymio-trap": {**_COURSE, "reached_s": 60.0}, "thymio-closed": {"given_up_s": 60.0, "least_clearance_m": 0.10},
}
EXACT = (
    "lost_percent", "wall_contacts", "target_contacts", "crossed_on_red", "crossed_late", "least_crossings",
    "wrong_states_percent", "wall_contact_s",
)
"""Figures that leave no room."""
_ACQUIRES = ("bearing_rms_deg", "distance_rms_m", "lost_percent")
"""Figures that are taken from the first acquisition on."""


def checks_of(scenario: str, result: Score, latency_ms: float = 0.0, factor: float = 1.0) -> list[Check]:
    """Hold `result` against the bounds of `scenario`, each times `factor` but for those that leave no room."""
    if latency_ms >= STANDS_STILL_FROM_MS:
        return [_check("travelled_m", result, 0.05), _check("wall_contacts", result, 0.0)]
    bounds = dict(BOUNDS[scenario] if scenario in BOUNDS else _usual(result))
    if "wall_contact_s" not in bounds:
        bounds["wall_contacts"] = 0.0
    checks = [_check(name, result, _granted(name, bound, factor)) for name, bound in bounds.items()]
    if "acquired_s" not in bounds and _must_acquire(bounds):
        checks.insert(0, Check("acquired_s", result.acquired_s, "s", result.seconds, result.acquired_s is not None))
    return checks


def _usual(result: Score) -> dict[str, float]:
    """Of a scenario of somebody's own: what its kind demands, by what there was to be judged."""
    if "least_crossings" in result.figures:
        return _LIGHT
    return {**_COURSE, "reached_s": result.seconds} if "reached_s" in result.figures else {}


def _must_acquire(bounds: dict[str, float]) -> bool:
    """Where nothing else of a following is demanded, that it began at all is."""
    return any(name in _ACQUIRES for name in bounds) or set(bounds) <= {"wall_contacts", "wall_contact_s"}


def _granted(name: str, bound: float, factor: float) -> float:
    if name in EXACT:
        return bound
    return bound / factor if name.startswith(AT_LEAST) else bound * factor


def _check(name: str, result: Score, bound: float) -> Check:
    value = result.figure(name)
    ok = value is not None and (value >= bound if name.startswith(AT_LEAST) else value <= bound)
    return Check(name, value, UNITS[name], bound, ok)
