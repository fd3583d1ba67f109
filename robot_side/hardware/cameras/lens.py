"""The lens of a camera plug-in: a calibrated model from a file or options, else a guess from its angle. Shell.

The file has the format of `sightline calibrate camera`: the fields of `sightline.protocol.messages.CameraModel` as
TOML.
"""

import json
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from sightline.protocol.config import Config, file_text, first_problem
from sightline.protocol.errors import ConfigError
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import CameraModel


class LensConfig(Config):
    """`model_file` (TOML) or `model` (the same fields as a table); without them the lens is guessed from `hfov_deg`.

    `hfov_deg` is the horizontal field of view. A model guessed from it is marked as not calibrated.
    """

    hfov_deg: Annotated[float, Field(gt=5, lt=175)] = 60.0
    model_file: Path | None = None
    model: dict[str, Any] | None = None

    def given_model(self) -> CameraModel | None:
        """Return the calibrated model, or None without one.

        Raises ConfigError for an unreadable file, an invalid or unknown field, and two sources.
        """
        if self.model_file is not None and self.model is not None:
            raise ConfigError("camera options model and model_file are both set; keep one")
        if self.model_file is not None:
            return read_model(self.model_file)
        return None if self.model is None else _checked(self.model, "camera option model")


def camera_model(config: LensConfig, size: JpegSize) -> CameraModel:
    """Return the model of images of `size`.

    Raises ConfigError as `given_model`, and for a model of another size. A camera may crop, so no model is scaled.
    """
    given = config.given_model()
    if given is None:
        return guessed_model(size, config.hfov_deg)
    return _fitting(given, size, str(config.model_file or "camera option model"))


def guessed_model(size: JpegSize, hfov_deg: float) -> CameraModel:
    """Return the model of a lens without distortion, with its axis through the center of the image."""
    focal_px = size.width_px / 2 / math.tan(math.radians(hfov_deg) / 2)
    return CameraModel(
        width_px=size.width_px,
        height_px=size.height_px,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=size.width_px / 2,
        cy_px=size.height_px / 2,
    )


def read_model(path: Path) -> CameraModel:
    """Read a model from a TOML file. Raises ConfigError that names the file and the invalid value."""
    try:
        table = tomllib.loads(file_text(path))
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read: {error.strerror}; `sightline calibrate camera` writes one"
        ) from None
    except (ValueError, RecursionError) as error:  # also for a number with too many digits
        raise ConfigError(f"{path}: invalid TOML: {error}") from None
    return _checked(table, str(path))


def _checked(table: dict[str, Any], where: str) -> CameraModel:
    """Check the fields of a file. An unknown field is an error, while on the wire it may come from a newer peer."""
    unknown = sorted(set(table) - set(CameraModel.model_fields))
    if unknown:
        known = ", ".join(CameraModel.model_fields)
        raise ConfigError(f"{where}: unknown field {unknown[0]!r} of a camera model; known: {known}")
    try:
        return CameraModel.model_validate_json(json.dumps(table, default=str))
    except ValidationError as error:
        raise ConfigError(f"{where}: {first_problem(error)}") from None


def _fitting(model: CameraModel, size: JpegSize, where: str) -> CameraModel:
    if (model.width_px, model.height_px) != (size.width_px, size.height_px):
        raise ConfigError(
            f"{where} is for {model.width_px}x{model.height_px}, the camera delivers "
            f"{size.width_px}x{size.height_px}; calibrate at this size, or choose the other size"
        )
    return model
