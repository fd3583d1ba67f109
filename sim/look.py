"""How pictures look: light and camera defects as data (`looks.toml`). Pure."""

import difflib
from pathlib import Path
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError
from sightline.sim.toml_file import check, read_table

LOOKS = Path(__file__).parent / "looks.toml"

Gain = Annotated[float, Field(gt=0, le=4)]


class Look(Config):
    """What happens to a picture between the scene and the JPEG, in this order."""

    exposure: Gain = 1.0
    """Brightness factor; above 1 the bright parts burn out."""
    saturation: Annotated[float, Field(ge=0, le=2)] = 1.0
    """Colourfulness: 0 is a grey picture."""
    white_balance: tuple[Gain, Gain, Gain] = (1.0, 1.0, 1.0)
    """Factors on red, green, blue."""
    blur_px: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the lens's blur."""
    noise: Annotated[float, Field(ge=0, le=64)] = 2.0
    """Standard deviation, in steps of 0..255."""
    jpeg_quality: Annotated[int, Field(ge=5, le=100)] = 80


def look_named(name: str) -> Look:
    """A look of `looks.toml`. Raises ConfigError with the nearest name."""
    table = read_table(LOOKS)
    if name not in table:
        near = difflib.get_close_matches(name, table, n=1)
        hint = f", did you mean {near[0]!r}?" if near else ""
        raise ConfigError(f"no look called {name!r}{hint}; there are {', '.join(sorted(table))}")
    return check(Look, table[name], LOOKS)
