"""Every number of the vision side, with its unit, bounds and reason. Pure."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from sightline.protocol.channels import FRAME
from sightline.protocol.config import Config
from sightline.protocol.messages import CameraModel, Source
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT

Fraction = Annotated[float, Field(ge=0, le=1)]
HueDeg = Annotated[float, Field(ge=0, le=360)]
Seconds = Annotated[float, Field(ge=0, le=60)]


class HsvRange(Config):
    """One two-sided color range. A hue range whose low end is above its high end goes through red (360 = 0)."""

    hue_low_deg: HueDeg
    hue_high_deg: HueDeg
    saturation_low: Fraction = 0.45
    saturation_high: Fraction = 1.0
    value_low: Fraction = 0.15
    value_high: Fraction = 1.0


class HsvConfig(Config):
    """The color detector."""

    ranges: Annotated[tuple[HsvRange, ...], Field(min_length=1, max_length=8)] = (
        HsvRange(hue_low_deg=36, hue_high_deg=68, saturation_low=0.5),
    )
    shape: Literal["disc", "any"] = "disc"
    """`any`: whatever has the color, e.g. a box; its range then follows from `boxes.height_m` or `boxes.width_m`."""
    min_radius_px: Annotated[float, Field(gt=1, le=200)] = 3.0
    max_contours: Annotated[int, Field(ge=1, le=256)] = 16
    """Security limit: no more blobs than this are measured in one image, the longest outlines first."""
    max_roughness: Annotated[float, Field(gt=0, le=0.5)] = 0.07
    """RMS distance of the outline from a circle, in radii; a square has 0.10."""
    min_outline_kept: Annotated[float, Field(ge=0.2, le=1)] = 0.55
    """Share of the outline that must lie on the circle; the rest may be cut off by something in front."""


Device = Literal["auto", "cpu", "cuda", "tensorrt"]
"""Device of a model. `auto` takes the best available one and logs it. Any other value is required at the start."""


class DetectorConfig(Config):
    """The detector: one of `sightline detector list`, or `boxes`, which another service publishes as `detections`."""

    renamed_keys: ClassVar[Mapping[str, str]] = {"only_colour": "only_color"}
    kind: Annotated[str, Field(min_length=1, max_length=256)] = "hsv"
    """A name, or `package.module:Name`; what follows a colon is the detector's own: onnx:ball.onnx, oip+http://..."""
    options: dict[str, Any] = Field(default_factory=dict)
    """For the detector's own `Config`."""
    device: Device = "auto"
    deadline_s: Annotated[float, Field(ge=0.005, le=1)] = 0.1
    """Deadline of a remote detector. After it, the robot already slows down, so a later answer does not count."""
    labels: Annotated[tuple[str, ...], Field(max_length=64)] = ()
    """Only detections with one of these labels count, and `target` of the color detectors; empty for all."""
    only_color: bool = False
    """Only detections that are mostly of the colors of `hsv.ranges` count.

    The model finds balls, the color selects one.
    """
    tracked: bool = False
    """Give what is found in one frame after the other the same `track_id`."""
    fallback: Annotated[str, Field(max_length=256)] = ""
    """The detector that drives on while the other does not answer; empty for none, and the robot holds."""
    shadow: Annotated[str, Field(max_length=256)] = ""
    """A second detector that looks at the same frames, is compared and never steers."""
    shadow_options: dict[str, Any] = Field(default_factory=dict)


class BoxesConfig(Config):
    """Steering by boxes, when the detector is `boxes`. Without a size the robot only turns toward the box.

    The sizes are also those of what the color detector finds with `hsv.shape` `any`.
    """

    source: Source = "guest"
    """Whose boxes."""
    label: Annotated[str, Field(max_length=64)] = ""
    """The label that is meant, exactly; empty for any."""
    min_score: Fraction = 0.25
    height_m: Annotated[float | None, Field(gt=0.01, le=10)] = None
    """How tall the thing is; its range follows from it while top and bottom are in view."""
    width_m: Annotated[float | None, Field(gt=0.01, le=10)] = None
    """How wide it is, for when the height is not given or not in view."""


class MissionConfig(Config):
    """The mission: its name or `package.module:Name`. `options` are for its own `Config`."""

    kind: Annotated[str, Field(min_length=1, max_length=64)] = "follow"
    options: dict[str, Any] = Field(default_factory=dict)


class TargetConfig(Config):
    """The target and its distance."""

    radius_m: Annotated[float, Field(gt=0.005, le=2)] = 0.1
    stand_off_m: Annotated[float, Field(gt=0.1, le=10)] = 0.8
    """Distance to keep from the lens to the target's center, over the floor."""
    max_range_m: Annotated[float, Field(gt=0.2, le=50)] = 6.0
    label: Annotated[str, Field(max_length=64)] = ""
    """Label of the target. Empty selects any detection except traffic lights and legs."""


class TrackConfig(Config):
    """Memory of the target in the odometry frame."""

    acceleration_mps2: Annotated[float, Field(gt=0, le=20)] = 0.35
    """How hard the target is expected to change its velocity (1 sigma); more follows faster and smooths less."""
    range_noise: Annotated[float, Field(gt=0, le=1)] = 0.008
    """1 sigma of one position measured at one meter, in meters; grows with the square of the distance."""
    gate_m: Annotated[float, Field(gt=0, le=5)] = 0.35
    """A sighting further than this from where the target should be is another object ..."""
    gate_growth_mps: Annotated[float, Field(ge=0, le=10)] = 1.5
    """... and the gate widens by this for every second without a sighting."""
    coast_s: Annotated[float, Field(ge=0, le=5)] = 0.5
    """Without a sighting, drive on for this long where the target should be; then only turn toward it."""
    give_up_s: Annotated[float, Field(gt=0, le=10)] = 1.2
    """Without a sighting for this long the target is lost, and nothing of it is kept but its side."""
    confirm: Annotated[int, Field(ge=1, le=30)] = 2
    """Sightings before the robot drives toward it; it turns at once."""


class SteerConfig(Config):
    """Bearing and distance controllers. Gains are per second; kp times latency never exceeds `max_gain_latency`."""

    bearing_kp: Annotated[float, Field(gt=0, le=20)] = 6.0
    bearing_ki: Annotated[float, Field(ge=0, le=20)] = 1.5
    distance_kp: Annotated[float, Field(gt=0, le=10)] = 3.0
    distance_ki: Annotated[float, Field(ge=0, le=10)] = 0.3
    max_gain_latency: Annotated[float, Field(gt=0, le=0.9)] = 0.9
    max_linear_mps: Annotated[float, Field(gt=0, le=5)] = 0.5
    max_reverse_mps: Annotated[float, Field(ge=0, le=5)] = 0.3
    max_angular_rad_s: Annotated[float, Field(gt=0, le=10)] = 2.5
    integral_linear_mps: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Bound of the distance integral: what wheel and friction errors need, no more."""
    integral_angular_rad_s: Annotated[float, Field(ge=0, le=2)] = 0.05
    back_calculation_hz: Annotated[float, Field(ge=0, le=50)] = 5.0
    """How fast an integral gives way to what the robot did not carry out."""
    drive_within_rad: Annotated[float, Field(gt=0, le=1.5)] = 0.9
    """Forward speed fades to zero as the bearing grows to this."""


class LatencyConfig(Config):
    """The delay from capture to wheels. Prefer a low value: too low is slow, too high is unstable."""

    first_guess_s: Annotated[float, Field(ge=0, le=0.5)] = 0.03
    max_s: Annotated[float, Field(gt=0, le=1)] = 0.4
    smoothing_s: Annotated[float, Field(gt=0, le=10)] = 0.5
    actuation_s: Annotated[float, Field(ge=0, le=0.3)] = 0.03
    """From an accepted command to wheels that follow it; the robot cannot measure this part."""
    linear_acceleration_mps2: Annotated[float, Field(gt=0, le=50)] = 2.0
    angular_acceleration_rad_s2: Annotated[float, Field(gt=0, le=200)] = 10.0
    """The robot's own limits, for the prediction of where the commands in flight will take it."""


class SearchConfig(Config):
    """Turning on the spot after "saw nothing"; bounded by time spent turning and by angle."""

    enabled: bool = True
    rate_rad_s: Annotated[float, Field(gt=0, le=1.2)] = 1.2
    max_turn_rad: Annotated[float, Field(gt=0, le=50)] = 14.0
    max_turning_s: Seconds = 20.0
    after_s: Annotated[float, Field(ge=0, le=10)] = 0.2
    """Images without the target must last this long before the robot turns for it."""


class ViewingConfig(Config):
    """The channels `overlay` and `preview` for viewers."""

    overlay_hz: Annotated[float, Field(gt=0, le=60)] = 15.0
    overlay_width_px: Annotated[int, Field(ge=160, le=1920)] = 640
    """However wide the camera's images are: the words drawn into it must be legible."""
    overlay_quality_percent: Annotated[int, Field(ge=20, le=95)] = 80
    preview_hz: Annotated[float, Field(gt=0, le=60)] = 10.0
    preview_width_px: Annotated[int, Field(ge=64, le=640)] = 320
    preview_quality_percent: Annotated[int, Field(ge=20, le=95)] = 60


def _camera_of_file(value: Any) -> Any:
    """Read lists from a file as tuples, which the strict model of the wire requires."""
    return CameraModel.model_validate(value, strict=False) if isinstance(value, dict) else value


class VisionConfig(Config):
    """The vision service."""

    robot: Annotated[str, Field(pattern=r"^[A-Za-z0-9*?][A-Za-z0-9_.*?-]{0,31}$")] = "r1"
    """A robot's id; with `*` or `?` every robot that fits, each with a pipeline of its own."""
    connect: Annotated[tuple[str, ...], Field(max_length=16)] = (DEFAULT_ENDPOINT,)
    listen: Annotated[tuple[str, ...], Field(max_length=16)] = ()
    secure: str = ""
    """A folder of `sightline keys`: mutual TLS and access rules; endpoints are then tls/... or quic/..."""
    max_frame_bytes: Annotated[int, Field(ge=1_000, le=FRAME.max_payload_bytes)] = 400_000
    """Security limit: the link rejects larger frames."""
    max_pixels: Annotated[int, Field(ge=256, le=4096 * 4096)] = 1920 * 1080
    """Security limit: larger images are never decoded."""
    detector: DetectorConfig = DetectorConfig()
    hsv: HsvConfig = HsvConfig()
    boxes: BoxesConfig = BoxesConfig()
    mission: MissionConfig = MissionConfig()
    missions: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Options by the name of the mission, for those that may be requested while vision runs, e.g. missions.goto."""
    target: TargetConfig = TargetConfig()
    track: TrackConfig = TrackConfig()
    steer: SteerConfig = SteerConfig()
    latency: LatencyConfig = LatencyConfig()
    search: SearchConfig = SearchConfig()
    viewing: ViewingConfig = ViewingConfig()
    camera: Annotated[CameraModel | None, BeforeValidator(_camera_of_file)] = None
    """Model for robots that do not publish one (legacy protocol). A published model takes precedence."""
