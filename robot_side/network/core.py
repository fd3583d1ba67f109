"""Logic of the network process: pictures in, frames out, credit, camera adaptation. Pure."""

from collections.abc import Mapping

from sightline.protocol.channels import CAMERA, FRAME
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import (
    MAX_CHANNELS_SHOWN,
    AnswerHeader,
    CameraModel,
    FrameHeader,
    Holder,
    Planar,
    Pose,
    Stamp,
    StreamStatus,
)
from sightline.protocol.transports.link import Message
from sightline.robot_side.network.bitrate_control import EncodingTarget
from sightline.robot_side.network.stream import Stream, StreamConfig
from sightline.robot_side.pipe import CommandAck, Motion
from sightline.robot_side.ports import Adjustable, Camera, Picture, scaled_model


class CameraAdaptation:
    """Passes the stream's wish on, once per change, to a camera that can follow it."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._told = EncodingTarget()
        self._scale_percent = 100
        self.shown = EncodingTarget()
        """What the camera does: unchanged where it passes its own JPEGs through."""

    def follow(self, wish: EncodingTarget) -> None:
        """Ask for `wish` unless that was asked already; a camera that is gone is asked when it is back."""
        if wish == self._told or not isinstance(self._camera, Adjustable):
            return
        try:
            followed = self._camera.adjust(*wish)
        except HardwareError:
            return  # reading says so
        self._told = wish
        if followed:
            self.shown = wish

    def seen(self, picture: Picture) -> CameraModel:
        """The model of `picture`, the newest."""
        self._scale_percent = picture.scale_percent
        return self.model

    def shown_in(self, status: StreamStatus, dropped: Mapping[str, int]) -> StreamStatus:
        """`status` with what the camera does and what its slot and the link's slots dropped, by channel."""
        missed = getattr(self._camera, "missed_captures", None)  # of cameras that capture by themselves
        counted = sorted(((name, count) for name, count in dropped.items() if count), key=lambda item: -item[1])
        return status.model_copy(update={
            "quality_percent": self.shown.quality_percent,
            "scale_percent": self.shown.scale_percent,
            "calibrated": self._camera.model.calibrated,
            "dropped": dict(counted[:MAX_CHANNELS_SHOWN]),
            "missed_captures": missed() if missed else 0,
        })

    @property
    def model(self) -> CameraModel:
        """The model of the newest picture."""
        return scaled_model(self._camera.model, self._scale_percent)


# The network process's own logic: pictures in, frames out, credit. Pure; `network.py` is its shell.


_CAMERA_PERIOD_US = 500_000


class NetworkCore:
    """One network process of one robot session; `first_seq` continues where an earlier process ended."""

    def __init__(self, config: StreamConfig, session: str, first_seq: int, max_frame_bytes: int) -> None:
        self.motion = Motion()
        self._refused_pictures = 0
        self._stream = Stream(config)
        self._session = session
        self._seq = first_seq
        self._max_frame_bytes = max_frame_bytes
        self._last_t_us = -1
        self._camera_seq = 0
        self._camera_due_us = 0
        self._told_model: CameraModel | None = None

    def may_capture(self, now_us: int, listening: bool) -> bool:
        """Whether to take a picture now."""
        return self._stream.may_capture(now_us, listening)

    def wait_us(self, now_us: int) -> int:
        """How long to wait for time alone to change `may_capture`."""
        return self._stream.wait_us(now_us)

    def on_camera(self, picture: Picture, now_us: int) -> tuple[FrameHeader, Message] | None:
        """The frame to publish; None, counted, for a picture too large or not newer than the last."""
        if picture.t_us <= self._last_t_us or len(picture.jpeg) > self._max_frame_bytes:
            self._refused_pictures += 1
            return None
        self._last_t_us = picture.t_us
        header = self._header(picture.t_us)
        self._stream.on_sent(self._seq, picture.t_us, now_us, len(picture.jpeg))
        self._seq += 1
        return header, Message(FRAME, "", encode(header), picture.jpeg)

    def _header(self, t_us: int) -> FrameHeader:
        motion = self.motion
        return FrameHeader(
            session=self._session,
            seq=self._seq,
            t_us=t_us,
            pose=_rounded_pose(motion.pose),
            moving=_rounded(motion.moving),
            applied=_rounded(motion.applied),
            latency_us=motion.latency_us,
        )

    def on_judged(self, judged: CommandAck, now_us: int) -> None:
        """The driver judged a twist: credit comes back, and goes to who drives."""
        self._stream.on_holder(judged.holder, now_us)
        self._answer(judged.sender, judged.seq, judged.compute_us, now_us)

    def on_ack(self, message: Message, now_us: int) -> None:
        """An acknowledgement: credit comes back. Raises WireError for what is none."""
        header = decode(AnswerHeader, message.header)
        if header.source == message.source and header.echo.session == self._session:
            who = Holder(source=header.source, session=header.session)
            self._answer(who, header.echo.seq, header.compute_us, now_us)

    def _answer(self, who: Holder, seq: int, compute_us: int, now_us: int) -> None:
        if seq < self._seq:
            self._stream.on_answer(who, seq, compute_us, now_us)

    @property
    def wish(self) -> EncodingTarget:
        """How the next picture should be encoded, where the camera can."""
        return self._stream.wish

    def camera_message(self, model: CameraModel, now_us: int) -> Message | None:
        """The model of the pictures that are sent: twice a second, and before the first picture of another model."""
        if now_us < self._camera_due_us and model == self._told_model:
            return None
        self._told_model = model
        self._camera_due_us = now_us + _CAMERA_PERIOD_US
        stamp = Stamp(session=self._session, seq=self._camera_seq, t_us=now_us)
        self._camera_seq += 1
        return Message(CAMERA, "", encode(stamp), encode(model))

    def status(self, now_us: int, dropped_commands: int = 0) -> StreamStatus:
        """Counters of the stream."""
        status = self._stream.status(now_us, dropped_commands)
        return status.model_copy(update={"refused_pictures": self._refused_pictures})


def _rounded(pair: Planar) -> Planar:
    return round(pair[0], 4), round(pair[1], 4)


def _rounded_pose(pose: Pose) -> Pose:
    return round(pose[0], 4), round(pose[1], 4), round(pose[2], 5)
