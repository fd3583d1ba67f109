"""Define the states of the gate and their transitions. Pure.

    state      wheels                         ends by
    DISARMED   zero; commands are validated   arm
    HOLD       ramp to zero, then held        a fresh command; ten seconds; disarm
    ACTIVE     apply the command              silence, age; disarm
    DEGRADED   apply, speed limit lowered     silence, age; disarm
    STOPPED    zero, latched                  reset (never starts motion: it leads to DISARMED)
    FAULT      zero, the drive failed         reset
"""

from dataclasses import dataclass
from enum import Enum

from sightline.protocol.messages import State


class Event(Enum):
    """The events that change the state of the gate."""

    ARM = "arm"
    DISARM = "disarm"
    STOP = "stop"
    RESET = "reset"
    FAULT = "the drive fails"
    FREE = "nothing limits the speed"
    SLOWED = "something lowers the speed limit"
    MUST_HOLD = "something permits no motion"
    EXPIRED = "ten seconds in HOLD"
    HUMAN_LOST = "the human holder is lost"


# HOLD counts as armed: a fresh command continues without a new request from the operator.
_ARMED = (State.HOLD, State.ACTIVE, State.DEGRADED)
_ANY = tuple(State)

TRANSITIONS: dict[tuple[State, Event], State] = {
    (State.DISARMED, Event.ARM): State.HOLD,
    (State.HOLD, Event.EXPIRED): State.DISARMED,
    (State.STOPPED, Event.RESET): State.DISARMED,
    (State.FAULT, Event.RESET): State.DISARMED,
    **{(state, Event.FREE): State.ACTIVE for state in _ARMED},
    **{(state, Event.SLOWED): State.DEGRADED for state in _ARMED},
    **{(state, Event.MUST_HOLD): State.HOLD for state in _ARMED},
    **{(state, Event.DISARM): State.DISARMED for state in _ARMED},
    **{(state, Event.HUMAN_LOST): State.DISARMED for state in _ARMED},
    **{(state, Event.FAULT): State.FAULT for state in _ANY if state is not State.STOPPED},
    **{(state, Event.STOP): State.STOPPED for state in _ANY},
}


@dataclass(frozen=True, slots=True)
class Cause:
    """A cause that limits the speed.

    Args:
        factor: share of the speed limit that remains, 0 to 1.
        reason: one line for the operator.
    """

    factor: float
    reason: str

    @property
    def event(self) -> Event:
        """Return the event that this cause triggers."""
        if self.factor == 0.0:
            return Event.MUST_HOLD
        return Event.SLOWED if self.factor < 1.0 else Event.FREE


def next_state(state: State, event: Event) -> State:
    """Return the state after `event`. Pairs outside the table change nothing."""
    return TRANSITIONS.get((state, event), state)


def is_armed(state: State) -> bool:
    """Return True if the wheels may turn in `state`."""
    return state in _ARMED
