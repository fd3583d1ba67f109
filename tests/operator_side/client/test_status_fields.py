"""Each field of a status has its place in the text and in the metrics; schema and JavaScript have their own tests."""

import pytest

from sightline.operator_side.client.status import status_lines
from sightline.operator_side.cockpit.metrics import Watched
from sightline.protocol.codec import encode
from sightline.protocol.messages import LastRejection, LeaseHolder, Stamp, State, Status, StreamStatus
from sightline.protocol.transports.link import Message

OTHERS = {"state": State.HOLD, "reason": "other"}
"""Other values for the fields without a default."""
GIVEN = {
    "state": State.DEGRADED,
    "reason": "slow",
    "holder": LeaseHolder(source="vision", digest="0000000a"),
    "applied": (0.25, 0.5),
    "refused": {"STALE": 24},
    "last_refusal": LastRejection(source="teleop", reason="STALE", detail="too old"),
    "dropped": {"scan": 18},
    "camera_fault": "camera v4l2 gives no image",
    "faults": {"callback": 3},
}
NUMBERS = {"boolean": lambda _count: True, "integer": lambda count: 11 + count, "number": lambda count: 11.5 + count}


def sample(model, **given):
    """Make a model with `given`, or a number or switch other than the default, in every field."""
    values = dict(given)
    for count, (field, schema) in enumerate(model.model_json_schema()["properties"].items()):
        if field in GIVEN:
            values[field] = GIVEN[field]
        elif field not in given:
            value = NUMBERS[schema.get("anyOf", [schema])[0]["type"]](count)
            values[field] = value * 1000 if field.endswith("_us") else value  # the text shows milliseconds
    return model(**values)


STREAM = sample(StreamStatus)
STATUS = sample(Status, stream=STREAM)
FIELDS = [*Status.model_fields, *(f"stream.{field}" for field in StreamStatus.model_fields)]
NO_NUMBERS = ("reason", "holder", "last_refusal", "stream.camera_fault")


def without(path: str) -> Status:
    """STATUS with the default, or another value, at `path`."""
    part, _, field = path.rpartition(".")
    model = STREAM if part else STATUS
    default = OTHERS.get(field, type(model).model_fields[field].get_default())
    assert default != getattr(model, field)
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
    names = {name.removeprefix("sightline_") for name, *_ in metrics(STATUS)}
    assert names >= {
        "up", "state", "linear_mps", "angular_rad_s", "frame_age_seconds", "latency_seconds", "tick_late_max_seconds",
        "stream_fps", "stream_window", "frames_sent_total", "frames_unanswered_total", "commands_accepted_total",
        "commands_refused_total", "network_restarts_total", "holds_total", "commands_dropped_total",
        "captures_missed_total", "frames_overtaken_total", "pictures_refused_total", "messages_dropped_total",
    }  # fmt: skip
    assert metrics(STATUS)["sightline_commands_refused_total", "r1", "STALE"] == 24
    assert metrics(STATUS)["sightline_messages_dropped_total", "r1", "scan"] == 18
    assert metrics(STATUS)["sightline_frame_age_seconds", "r1"] == STATUS.frame_age_us / 1e6
    assert metrics(STATUS)["sightline_frames_sent_total", "r1"] == STREAM.sent
