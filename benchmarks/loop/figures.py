"""What `bench loop` is asked to do. Pure."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sightline.protocol.errors import ConfigError

OURS: Final = "sightline"
FLOOR: Final = "floor"
TCP: Final = "tcp"
"""The least that two processes can do; a reference, and a rival only when the detector is slow."""
PEERS: Final = ("older", "lekiwi", "openpi", "callback")
"""What a user would build, one by one."""
OUR_DETECTOR: Final = "+our eyes"
"""After a peer's name: the peer with Sightline's own pipeline instead of its own, so that its transport alone shows."""
WITH_OUR_DETECTOR: Final = ("openpi", "callback")
"""Peers whose transport is quick enough for that to tell something."""
OWN_DETECTOR: Final = ("lekiwi", "openpi", "callback")
"""Peers that see as the older write-ups do; all others, floor and bare TCP included, have Sightline's pipeline."""
MAX_FPS: Final = 240.0
"""As much as the robot service takes."""
TAKEN_BOUND_PERCENT: Final = 5.0
"""More of the machine's time than this in other hands makes a sample inconclusive."""


@dataclass(frozen=True, slots=True)
class LoopSetting:
    """The same for every contestant. `pictures` is a folder of JPEGs of the given size."""

    pictures: Path
    width_px: int = 640
    height_px: int = 480
    fps: float = 30.0
    transport: str = "zenoh"
    detector_delay_ms: float = 0.0
    """Every detector waits so much longer, as for an accelerator."""
    overload: float = 0.0
    """How many times more pictures come than can be detected; 0 leaves the rate as it is."""
    busy_ms: float = 0.0
    """Every detector works at least so long on a picture, as on a slower processor; follows from `overload`."""
    seconds: float = 10.0
    peers: tuple[str, ...] = PEERS
    tries: int = 3
    """A sample that others disturbed is taken again, so often at most."""

    def __post_init__(self) -> None:
        """Raise ConfigError for what cannot be run."""
        if not 1 <= self.fps <= MAX_FPS or not 2 <= self.seconds <= 600 or not 0 <= self.detector_delay_ms <= 300:
            raise ConfigError("--fps 1 to 240, --seconds 2 to 600 and --detector-delay-ms 0 to 300, e.g. --fps 30")
        if self.overload and (not 1 < self.overload <= 10 or self.detector_delay_ms):
            raise ConfigError("--overload is above 1, at most 10, and without --detector-delay-ms, e.g. --overload 2")
        if not 64 <= self.width_px <= 1920 or not 64 <= self.height_px <= 1080:
            raise ConfigError(f"--size {self.width_px}x{self.height_px}: 64x64 to 1920x1080")

    @property
    def is_loaded(self) -> bool:
        """Whether more pictures come than can be detected."""
        return self.overload > 1 or self.detector_delay_ms > 1000 / self.fps

    @property
    def contestants(self) -> tuple[str, ...]:
        """Whoever runs, in this order; transports alone last."""
        alone = tuple(name + OUR_DETECTOR for name in WITH_OUR_DETECTOR if name in self.peers)
        return (FLOOR, OURS, *((TCP, *self.peers, *alone) if self.peers else ()))


def size_of(text: str) -> tuple[int, int]:
    """`640x480` as (width, height). Raises ConfigError for what is none."""
    width, cross, height = text.partition("x")
    if not cross or not (width + height).isascii() or not width.isdigit() or not height.isdigit():
        raise ConfigError(f"--size {text!r}: write WIDTHxHEIGHT, e.g. 640x480")
    return int(width), int(height)


def peers_of(text: str) -> tuple[str, ...]:
    """`all`, `none`, or names separated by commas. Raises ConfigError for a name that is none of `PEERS`."""
    if text in ("all", "none"):
        return PEERS if text == "all" else ()
    names = tuple(text.split(","))
    unknown = [name for name in names if name not in PEERS]
    if unknown:
        raise ConfigError(f"--peers {unknown[0]!r}: all, none, or of {', '.join(PEERS)}")
    return names
