"""What a simulation labels in its pictures, written to and read from its bus; `labels.py` makes it. Shell (sockets).

They come over the truth's socket, between its reports: whoever reads truth may read labels, a robot reads neither.
"""

import json
from collections import OrderedDict
from collections.abc import Iterable
from typing import Any, NamedTuple

from sightline.sim.bus import TRUTH, Connection

KEPT = 64
"""Pictures whose labels are remembered: two seconds of them."""
LABELLED_US = "labelled_us"
"""Key of a labels message: the capture time of the picture that they are of."""


class Label(NamedTuple):
    """One box, in pixels of the camera's whole picture; it may be encoded smaller."""

    label: str
    score: float
    x1_px: float
    y1_px: float
    x2_px: float
    y2_px: float


def to_json(labels: Iterable[Label], t_us: int, width_px: int) -> bytes:
    """The labels of the picture captured at `t_us`, `width_px` wide, as they go over the bus."""
    return json.dumps({LABELLED_US: t_us, "width_px": width_px, "boxes": [one._asdict() for one in labels]}).encode()


class LabelReader:
    """The labels of the newest pictures, by their capture times."""

    def __init__(self, socket_dir: str) -> None:
        self._connection = Connection(socket_dir, TRUTH)
        self._connection.hello()
        self._kept: OrderedDict[int, dict[str, Any]] = OrderedDict()

    def of(self, t_us: int, width_px: int) -> list[dict[str, Any]] | None:
        """The boxes of the picture captured at `t_us`, in pixels of one `width_px` wide; None if they were lost.

        They come before their picture.
        """
        self.drain()
        table = self._kept.get(t_us)
        return None if table is None else [_scaled(box, width_px / table["width_px"]) for box in table["boxes"]]

    def drain(self) -> None:
        """Take in what waits; often, for a socket holds ten messages. Raises HardwareError without a simulation."""
        while (message := self._connection.receive()) is not None:
            self._keep(message)

    def _keep(self, message: bytes) -> None:
        if f'"{LABELLED_US}"'.encode() not in message:
            return
        table = json.loads(message)
        self._kept[table[LABELLED_US]] = table
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)

    def close(self) -> None:
        """Idempotent."""
        self._connection.close()


def _scaled(box: dict[str, Any], factor: float) -> dict[str, Any]:
    return {name: value * factor if name.endswith("_px") else value for name, value in box.items()}
