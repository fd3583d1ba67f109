"""Every number of the vision side, with its unit, bounds and reason. Pure."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from sightline.protocol import NAME_PATTERN
from sightline.protocol.channels import FRAME
from sightline.protocol.config import Config
from sightline.protocol.messages import CameraModel, Source
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT
from sightline.protocol.transports.tokens import LEAST_WEIGHT, MOST_WEIGHT

Fraction = Annotated[float, Field(ge=0, le=1)]
HueDeg = Annotated[float, Field(ge=0, le=360)]
Seconds = Annotated[float, Field(ge=0, le=60)]


class HsvRange(Config):
    """One two-sided color range. A hue range whose low end is above its high end includes red (360 = 0)."""

    hue_low_deg: HueDeg
    hue_high_deg: HueDeg
    saturation_low: Fraction = 0.45
    saturation_high: Fraction = 1.0
    value_low: Fraction = 0.15
    value_high: Fraction = 1.0

    @model_validator(mode="after")
    def _is_not_empty(self) -> Self:
        """Reject a range without any color: only hue may wrap around."""
        for name in ("saturation", "value"):
            low, high = getattr(self, f"{name}_low"), getattr(self, f"{name}_high")
            if low > high:
                raise ValueError(f"{name}_low {low:g} is above {name}_high {high:g}; set both")
        return self


class HsvConfig(Config):
    """The color detector."""

    ranges: Annotated[tuple[HsvRange, ...], Field(min_length=1, max_length=8)] = (
        HsvRange(hue_low_deg=36, hue_high_deg=68, saturation_low=0.5),
    )
    """Colors of the target; hue 0 to 360, saturation and value 0 to 1. A hue range from high to low includes red."""
    shape: Literal["disc", "any"] = "disc"
    """`disc`: round objects. `any`: each object of the color; its range follows from `boxes.height_m` or `width_m`."""
    min_radius_px: Annotated[float, Field(gt=1, le=200)] = 3.0
    """Radius of the smallest target in the image."""
    max_contours: Annotated[int, Field(ge=1, le=256)] = 16
    """Security limit: most blobs that the detector measures in one image, longest outlines first."""
    max_roughness: Annotated[float, Field(gt=0, le=0.5)] = 0.07
    """RMS distance of the outline from a circle, in radii; a square has 0.10."""
    min_outline_kept: Annotated[float, Field(ge=0.2, le=1)] = 0.55
    """Least share of the outline on the circle; an object in front may hide the rest."""


Device = Literal["auto", "cpu", "cuda", "tensorrt"]
"""Device of a model. `auto` uses the best available device and logs it. Any other must exist at the start."""


class DetectorConfig(Config):
    """The detector: one of `sightline detector list`, or `boxes`, which another service publishes as `detections`."""

    renamed_keys: ClassVar[Mapping[str, str]] = {"only_colour": "only_color"}
    kind: Annotated[str, Field(min_length=1, max_length=256)] = "auto"
    """A name, or `package.module:Name`; a file or address follows a colon: onnx:ball.onnx, oip+http://... `auto` is the
    learned model. It is `hsv` without ONNX Runtime, and if `hsv.shape` is `any`."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the detector."""
    device: Device = "auto"
    """Device of a model: auto, cpu, cuda or tensorrt; only auto accepts another device."""
    deadline_s: Annotated[float, Field(ge=0.005, le=1)] = 0.1
    """Deadline of a remote detector. After it, the robot already slows down, so a later answer does not count."""
    labels: Annotated[tuple[str, ...], Field(max_length=64)] = ()
    """Only detections with these labels count, and those labeled `target` by a color detector; empty for all."""
    only_color: bool = False
    """Use only detections that are mostly of the colors of `hsv.ranges`.

    The model finds balls, the color selects one.
    """
    tracked: bool = False
    """Give an object the same `track_id` from frame to frame."""
    fallback: Annotated[str, Field(max_length=256)] = ""
    """Detector that steers while `kind` gives no answer. Empty: the robot holds."""
    shadow: Annotated[str, Field(max_length=256)] = ""
    """Second detector on the same frames, for comparison; it never steers."""
    shadow_options: dict[str, Any] = Field(default_factory=dict)
    """Options of the shadow detector."""


class BoxesConfig(Config):
    """Steering by boxes, when the detector is `boxes`. Without a size the robot only turns toward the box.

    The color detector with `hsv.shape` `any` uses the same sizes.
    """

    source: Source = "guest"
    """Source of the boxes."""
    label: Annotated[str, Field(max_length=64)] = ""
    """Exact label of the target; empty for any."""
    min_score: Fraction = 0.25
    """Boxes below this score do not count."""
    height_m: Annotated[float | None, Field(gt=0.01, le=10)] = None
    """Height of the object. It gives the range while the top and bottom edges are in view."""
    width_m: Annotated[float | None, Field(gt=0.01, le=10)] = None
    """Width of the object. It gives the range if the height does not."""


class MissionConfig(Config):
    """The mission and its options."""

    kind: Annotated[str, Field(min_length=1, max_length=64)] = "follow"
    """Name of the mission, or `package.module:Name`."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the mission, for its own `Config`."""


class TargetConfig(Config):
    """The target and its distance."""

    radius_m: Annotated[float, Field(gt=0.005, le=2)] = 0.1
    """Radius of the ball."""
    stand_off_m: Annotated[float, Field(gt=0.1, le=10)] = 0.8
    """Distance to keep from the lens to the target's center, over the floor; less than `max_range_m`."""
    max_range_m: Annotated[float, Field(gt=0.2, le=50)] = 6.0
    """Detections further away do not count."""
    label: Annotated[str, Field(max_length=64)] = ""
    """Label of the target. Empty selects any detection except traffic lights and legs."""

    @model_validator(mode="after")
    def _must_see_at_the_stand_off(self) -> Self:
        if self.stand_off_m >= self.max_range_m:
            raise ValueError(f"stand_off_m of {self.stand_off_m:g} m must be less than max_range_m, "
                             f"{self.max_range_m:g} m: the robot would back away until it loses the target")
        return self


class TrackConfig(Config):
    """Memory of the target in the odometry frame."""

    acceleration_mps2: Annotated[float, Field(gt=0, le=20)] = 0.35
    """Expected acceleration of the target (1 sigma); a higher value follows faster and smooths less."""
    range_noise: Annotated[float, Field(gt=0, le=1)] = 0.008
    """1 sigma of a position measured at 1 m, in meters; grows with the square of the distance."""
    gate_m: Annotated[float, Field(gt=0, le=5)] = 0.35
    """A detection further than this from the expected position is another object."""
    gate_growth_mps: Annotated[float, Field(ge=0, le=10)] = 1.5
    """Growth of this gate while the target is not detected, up to three sigma of the expected position."""
    apart_m: Annotated[float, Field(ge=0, le=5)] = 0.15
    """A detection nearer than this to an object is a part of it, or a second detection of it."""
    coast_s: Annotated[float, Field(ge=0, le=5)] = 0.5
    """Time without a detection in which the robot drives to the expected position; then it only turns."""
    give_up_s: Annotated[float, Field(gt=0, le=10)] = 1.2
    """Time without a detection after which the target is lost. Only its side remains known."""
    confirm: Annotated[int, Field(ge=1, le=30)] = 2
    """Detections before the robot drives toward a target; it turns immediately."""


class SteerConfig(Config):
    """Bearing and distance controllers. Gains are per second; kp times latency never exceeds `max_gain_latency`."""

    bearing_kp: Annotated[float, Field(gt=0, le=20)] = 6.0
    """Proportional gain of the bearing, 1/s."""
    bearing_ki: Annotated[float, Field(ge=0, le=20)] = 1.5
    """Integral gain of the bearing, 1/s2."""
    distance_kp: Annotated[float, Field(gt=0, le=10)] = 3.0
    """Proportional gain of the distance, 1/s."""
    distance_ki: Annotated[float, Field(ge=0, le=10)] = 0.3
    """Integral gain of the distance, 1/s2."""
    max_gain_latency: Annotated[float, Field(gt=0, le=0.9)] = 0.9
    """Highest product of a proportional gain and the latency; a higher one oscillates."""
    max_linear_mps: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Highest requested speed."""
    max_reverse_mps: Annotated[float, Field(ge=0, le=5)] = 0.3
    """Highest requested speed backward."""
    max_angular_rad_s: Annotated[float, Field(gt=0, le=10)] = 2.5
    """Highest requested turn rate."""
    integral_linear_mps: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Bound of the distance integral, enough for wheel and friction errors."""
    integral_angular_rad_s: Annotated[float, Field(ge=0, le=2)] = 0.05
    """Bound of the bearing integral."""
    back_calculation_hz: Annotated[float, Field(ge=0, le=50)] = 5.0
    """Rate at which an integral shrinks by the part of the command that the robot did not apply."""
    drive_within_rad: Annotated[float, Field(gt=0, le=1.5)] = 0.9
    """Forward speed fades to zero as the bearing grows to this value."""


class LatencyConfig(Config):
    """The delay from capture to wheels. Prefer a low value: too low is slow, too high is unstable."""

    first_guess_s: Annotated[float, Field(ge=0, le=0.5)] = 0.03
    """Latency before the first measurement."""
    max_s: Annotated[float, Field(gt=0, le=1)] = 0.4
    """Upper limit of the measured latency."""
    smoothing_s: Annotated[float, Field(gt=0, le=10)] = 0.5
    """Time constant of the smoothing."""
    actuation_s: Annotated[float, Field(ge=0, le=0.3)] = 0.03
    """Time from an accepted command to the motion of the wheels. The robot cannot measure this part."""
    linear_acceleration_mps2: Annotated[float, Field(gt=0, le=50)] = 2.0
    """Acceleration limit of the robot, for the prediction of commands in flight."""
    angular_acceleration_rad_s2: Annotated[float, Field(gt=0, le=200)] = 10.0
    """Angular acceleration limit of the robot, for the same prediction."""


class SearchConfig(Config):
    """Turning on the spot after an image without the target, bounded by time and by angle."""

    enabled: bool = True
    """True to search for a lost target."""
    rate_rad_s: Annotated[float, Field(gt=0, le=1.2)] = 1.2
    """Turn rate of the search."""
    max_turn_rad: Annotated[float, Field(gt=0, le=50)] = 14.0
    """The search ends after this angle."""
    max_turning_s: Seconds = 20.0
    """The search ends after this time of turning."""
    after_s: Annotated[float, Field(ge=0, le=10)] = 0.2
    """Time without the target before the search starts."""


class ViewingConfig(Config):
    """The channels `overlay` and `preview` for viewers."""

    overlay_hz: Annotated[float, Field(gt=0, le=60)] = 15.0
    """Most overlay images per second."""
    overlay_width_px: Annotated[int, Field(ge=160, le=1920)] = 640
    """Width of the overlay for any camera, so that its text is legible."""
    overlay_quality_percent: Annotated[int, Field(ge=20, le=95)] = 80
    """JPEG quality of the overlay."""
    preview_hz: Annotated[float, Field(gt=0, le=60)] = 10.0
    """Most preview images per second."""
    preview_width_px: Annotated[int, Field(ge=64, le=640)] = 320
    """Largest width of the preview."""
    preview_quality_percent: Annotated[int, Field(ge=20, le=95)] = 60
    """JPEG quality of the preview."""


class ShareConfig(Config):
    """Several vision services that share the robots of a site."""

    enabled: bool = False
    """True to share: the service drives the robots that it owns, and is standby for others. It needs Zenoh."""
    name: Annotated[str, Field(pattern=f"^({NAME_PATTERN})?$")] = ""
    """Unique name among the services; empty for a new name at each start."""
    weight: Annotated[float, Field(ge=LEAST_WEIGHT, le=MOST_WEIGHT)] = 1.0
    """Share of the robots, relative to the weights of the other services."""

    @model_validator(mode="after")
    def _has_effect(self) -> Self:
        if not self.enabled and (self.name or self.weight != 1.0):
            raise ValueError("a name or a weight needs --share (share.enabled = true)")
        return self


def _camera_of_file(value: Any) -> Any:
    """Read lists from a file as tuples, which the strict model of the wire requires."""
    return CameraModel.model_validate(value, strict=False) if isinstance(value, dict) else value


class VisionConfig(Config):
    """The vision service."""

    robot: Annotated[str, Field(pattern=r"^[A-Za-z0-9*?][A-Za-z0-9_.*?-]{0,31}$")] = "r1"
    """Robot id; with `*` or `?` every robot that matches, each with a separate pipeline."""
    connect: Annotated[tuple[str, ...], Field(max_length=16)] = (DEFAULT_ENDPOINT,)
    """Robot or router to connect to."""
    listen: Annotated[tuple[str, ...], Field(max_length=16)] = ()
    """Endpoints to which robots may connect."""
    secure: str = ""
    """Folder of `sightline keys` for mutual TLS and access rules; endpoints are then tls/... or quic/..."""
    max_frame_bytes: Annotated[int, Field(ge=1_000, le=FRAME.max_payload_bytes)] = 400_000
    """Security limit: the link rejects larger frames."""
    max_pixels: Annotated[int, Field(ge=256, le=4096 * 4096)] = 1920 * 1080
    """Security limit: the vision service does not decode larger images."""
    detector: DetectorConfig = DetectorConfig()
    hsv: HsvConfig = HsvConfig()
    boxes: BoxesConfig = BoxesConfig()
    mission: MissionConfig = MissionConfig()
    missions: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Options of other missions by name, for a later request, e.g. `missions.goto`."""
    target: TargetConfig = TargetConfig()
    track: TrackConfig = TrackConfig()
    steer: SteerConfig = SteerConfig()
    latency: LatencyConfig = LatencyConfig()
    search: SearchConfig = SearchConfig()
    viewing: ViewingConfig = ViewingConfig()
    share: ShareConfig = ShareConfig()
    camera: Annotated[CameraModel | None, BeforeValidator(_camera_of_file)] = None
    """Model for robots that do not publish one (legacy protocol). A published model takes precedence."""
