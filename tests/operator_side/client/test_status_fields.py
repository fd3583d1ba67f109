"""Each field of a status has its place in the text and in the metrics; schema and JavaScript have their own tests."""

import pytest

from sightline.operator_side.client.status import status_lines
from sightline.operator_side.cockpit.metrics import Watched
from sightline.protocol.codec import encode
from sightline.protocol.messages import Holder, LastRejection, Stamp, State, Status, StreamStatus
from sightline.protocol.transports.link import Message

STREAM = StreamStatus(
    sent=11, credit_timeouts=12, window=13, fps=14.0, dropped_commands=15, refused_pictures=16, calibrated=True,
    overtaken=17, dropped={"scan": 18}, missed_captures=19, quality_percent=61, scale_percent=62,
)  # fmt: skip
STATUS = Status(
    state=State.DEGRADED, reason="slow", holder=Holder(source="vision", session="0000000a"), applied=(0.25, 0.5),
    frame_age_us=21_000, latency_us=22_000, accepted=23, refused={"STALE": 24},
    last_refusal=LastRejection(source="teleop", reason="STALE", detail="too old"), stream=STREAM, auto_arm=True,
    tick_late_max_us=26_000, network_restarts=27, max_linear_mps=0.75, max_angular_rad_s=1.5,
)  # fmt: skip
OTHERS = {"state": State.HOLD, "reason": "other"}
"""Of the fields without a default."""
FIELDS = [*Status.model_fields, *(f"stream.{field}" for field in StreamStatus.model_fields)]
NO_NUMBERS = ("reason", "holder", "last_refusal")


def without(path: str) -> Status:
    """STATUS with the default, or another value, at `path`."""
    part, _, field = path.rpartition(".")
    model = STREAM if part else STATUS
    default = OTHERS.get(field, type(model).model_fields[field].get_default())
    assert default != getattr(model, field), f"give {path} in {__name__} a value that is not its default"
    changed = model.model_copy(update={field: default})
    return STATUS.model_copy(update={"stream": changed}) if part else changed


class Link:
    robot = "r1"

    def subscribe(self, _channel, callback):
        self.callback = callback

    def peers(self):
        return []


def metrics(status: Status) -> dict[tuple[str, ...], float]:
    link = Link()
    watched = Watched(link)
    link.callback(Message("status", "", encode(Stamp(session="0000000a", seq=0, t_us=0)), encode(status)))
    samples = [sample for family in watched.collect() for sample in family.samples]
    return {(sample.name, *sample.labels.values()): sample.value for sample in samples}


@pytest.mark.parametrize("path", FIELDS)
def test_status_text_shows_each_field(path):
    assert list(status_lines("r1", without(path))) != list(status_lines("r1", STATUS)), (
        f"show {path} in operator_side/client/status.py"
    )


@pytest.mark.parametrize("path", [path for path in FIELDS if path not in NO_NUMBERS])
def test_metrics_have_each_number(path):
    assert metrics(without(path)) != metrics(STATUS), f"show {path} in operator_side/cockpit/metrics.py"


def test_metrics_keep_their_names():
    """Dashboards are built on them."""
    assert {name[0].removeprefix("sightline_"): value for name, value in metrics(STATUS).items() if value} == {
        "up": 1, "state": 1, "linear_mps": 0.25, "angular_rad_s": 0.5, "frame_age_seconds": 0.021,
        "latency_seconds": 0.022, "tick_late_max_seconds": 0.026, "stream_fps": 14, "stream_window": 13,
        "frames_sent_total": 11, "frames_unanswered_total": 12, "commands_accepted_total": 23,
        "commands_refused_total": 24, "network_restarts_total": 27, "commands_dropped_total": 15,
        "captures_missed_total": 19, "frames_overtaken_total": 17, "pictures_refused_total": 16,
        "messages_dropped_total": 18, "auto_arm": 1, "max_linear_mps": 0.75, "max_angular_rad_s": 1.5,
        "calibrated": 1, "quality_percent": 61, "scale_percent": 62,
    }  # fmt: skip
    assert metrics(STATUS)["sightline_commands_refused_total", "r1", "STALE"] == 24
    assert metrics(STATUS)["sightline_holds_total", "r1"] == 0
