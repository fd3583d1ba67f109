"""The base of every configuration model. Pure."""

from pydantic import BaseModel, ConfigDict


class Config(BaseModel):
    """Frozen; unknown keys, nan and inf are errors. Units are in the names, bounds in the fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
