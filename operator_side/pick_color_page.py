"""The page of `sightline pick-color`: click or box in a picture, see what the range marks, use it. Shell (threads)."""

import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from sightline.operator_side.loopback_page import Answer, PageRequest, Route, as_json, page
from sightline.operator_side.calibrate.color import (
    Box,
    Image,
    Ranges,
    check_trial,
    pick,
    ranges_text,
    trial_text,
    try_out,
)
from sightline.operator_side.pick_color_file import mask_png
from sightline.operator_side.calibrate.color_page import Gallery
from sightline.operator_side.calibrate.color_file import ranges_toml
from sightline.protocol.errors import ConfigError

_FIELDS = ("x_px", "y_px", "width_px", "height_px")


class PickPage:
    """One person's picking. `use` takes the ranges and says what became of them."""

    def __init__(self, gallery: Gallery, title: str, use: Callable[[Ranges], str]) -> None:
        self._gallery, self._title, self._use = gallery, title, use
        self._lock = threading.Lock()
        self._picked: tuple[Ranges, Image] | None = None
        self._good: Ranges | None = None
        self.done = threading.Event()

    @property
    def routes(self) -> Mapping[str, Route]:
        """For `served`."""
        return {
            "GET /": lambda _ask, _body: page("pick.html", title=self._title, live=str(self._gallery.live).lower()),
            "GET /pick.mjs": lambda _ask, _body: page("pick.mjs"),
            "GET /picture": self._gallery.route,
            "POST /pick": self._pick,
            "GET /mask": self._mask,
            "POST /use": self._take,
        }

    def _pick(self, _ask: PageRequest, body: bytes) -> Answer:
        asked = json.loads(body)
        picture = self._gallery.pixels(int(asked["number"]))
        with self._lock:
            self._picked = self._good = None
            ranges = pick(picture, Box(*(int(asked[name]) for name in _FIELDS)))
            self._picked = ranges, picture
            trial = try_out(ranges, self._gallery.recent())
            said: dict[str, Any] = {"ranges": ranges_text(ranges), "toml": f"ranges = {ranges_toml(ranges)}",
                                    "trial": trial_text(trial), **asdict(trial)}
            try:
                check_trial(trial)
            except ConfigError as error:
                return as_json({**said, "error": str(error)})
            self._good = ranges
            return as_json(said)

    def _mask(self, _ask: PageRequest, _body: bytes) -> Answer:
        with self._lock:
            return Answer(mask_png(*self._picked), "image/png") if self._picked else Answer(status=204)

    def _take(self, _ask: PageRequest, _body: bytes) -> Answer:
        with self._lock:
            if self._good is None:
                raise ConfigError("pick a colour first")
            said = self._use(self._good)
        self.done.set()
        return as_json({"said": said})
