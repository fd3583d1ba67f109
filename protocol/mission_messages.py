"""What is said about missions: what vision is to do, and what it does. Frozen, strict, bounded models. Pure."""

from typing import Annotated, Final

from pydantic import Field

from sightline.protocol.messages import Counter, Microseconds, Number, RequestId, WireModel

MAX_WAYPOINTS: Final = 64
"""Of one mission; a longer way is several."""
MAX_WAYPOINT_M: Final = 100.0
"""Each way from where odometry began: further off, wheels no longer know where they are."""
MAX_OPTIONS: Final = 16

MissionName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,31}$")]
"""As vision's own machine knows it; never a path to code."""
OptionName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_.]{0,63}$")]
OptionValue = bool | Number | Annotated[str, Field(max_length=64)]
Metres = Annotated[float, Field(ge=-MAX_WAYPOINT_M, le=MAX_WAYPOINT_M)]


class MissionRequest(WireModel):
    """What vision is to do from now on; `id` is the asker's own and comes back in the report."""

    id: Counter
    name: MissionName
    waypoints: Annotated[tuple[tuple[Metres, Metres], ...], Field(max_length=MAX_WAYPOINTS)] = ()
    """(x_m, y_m) in the odometry frame."""
    options: Annotated[dict[OptionName, OptionValue], Field(max_length=MAX_OPTIONS)] = {}  # noqa: RUF012
    """For the mission's own configuration; a dot reaches into its tables."""


class MissionReport(WireModel):
    """What vision does at the moment.

    `phase` is one or two words for a person, `note` the rest of the line. `asked` names the newest mission that was
    asked for, `refused` says why it was not taken up.
    """

    mission: Annotated[str, Field(max_length=64)]
    phase: Annotated[str, Field(max_length=32)]
    note: Annotated[str, Field(max_length=200)] = ""
    done: bool = False
    asked: RequestId | None = None
    refused: Annotated[str, Field(max_length=200)] = ""
    detector: Annotated[str, Field(max_length=64)] = ""
    device: Annotated[str, Field(max_length=32)] = ""
    model: Annotated[str, Field(max_length=64)] = ""
    inference_us: Microseconds | None = None
