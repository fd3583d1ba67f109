"""A film on disk, H.264 in MP4, each picture at its own time. Shell (writes a file)."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.operator_side.preflight import needs
from sightline.protocol.errors import ConfigError

Image = NDArray[np.uint8]
_TICKS_PER_S: Final = 90_000  # what players expect of H.264
_TIME_BASE: Final = Fraction(1, _TICKS_PER_S)
_ENCODING: Final = {"preset": "veryfast", "crf": "23"}


class Film:
    """`with Film(path, fps) as film: film.add(picture, t_us)`. Pictures of another size are made to fit the first."""

    def __init__(self, path: Path, fps: int) -> None:
        """`fps` is only told to the encoder. Raises ConfigError without PyAV or for a place that cannot be written."""
        with needs("report"):
            import av
        try:
            self._container = av.open(str(path), "w", options={"movflags": "+faststart"})
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from None
        self._av, self._fps = av, fps
        self._stream: Any = None
        self._first_us = self._last_ticks = -1
        self.frames = 0

    def add(self, picture: Image, t_us: int) -> bool:
        """One more picture (BGR); False, and left out, if it is not later than the last."""
        if self._stream is None:
            self._first_us = t_us
            self._stream = self._opened(picture)
        ticks = (t_us - self._first_us) * _TICKS_PER_S // 1_000_000
        if ticks <= self._last_ticks:
            return False
        self._last_ticks = ticks
        frame = self._av.VideoFrame.from_ndarray(self._fitted(picture), format="bgr24")
        frame.pts, frame.time_base = ticks, _TIME_BASE
        self._container.mux(self._stream.encode(frame))
        self.frames += 1
        return True

    @property
    def seconds(self) -> float:
        """From the first picture to the last."""
        return max(0, self._last_ticks) / _TICKS_PER_S

    def close(self) -> None:
        """Write what the encoder still holds, and the index."""
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _opened(self, picture: Image) -> Any:
        stream = self._container.add_stream("libx264", rate=self._fps)
        height, width = picture.shape[:2]
        stream.width, stream.height = max(2, width - width % 2), max(2, height - height % 2)
        stream.pix_fmt = "yuv420p"  # what every player shows; it wants even sides
        stream.time_base = stream.codec_context.time_base = _TIME_BASE
        stream.options = dict(_ENCODING)
        return stream

    def _fitted(self, picture: Image) -> Image:
        size = (self._stream.width, self._stream.height)
        if (picture.shape[1], picture.shape[0]) == size:
            return np.ascontiguousarray(picture)
        if (picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2) == size:
            return np.ascontiguousarray(picture[: size[1], : size[0]])
        return np.ascontiguousarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
