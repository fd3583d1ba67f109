"""Logic of the network process: images in, frames out, credit, camera adaptation. Pure."""

from collections.abc import Mapping

from sightline.protocol.channels import CAMERA, FRAME
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import (
    MAX_CHANNELS_SHOWN,
    AnswerHeader,
    CameraModel,
    Echo,
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
from sightline.robot_side.pipe import CommandAck, RobotMotion
from sightline.robot_side.ports import Adjustable, Camera, Picture, scaled_model

_CAMERA_PERIOD_US = 500_000
_NOT_NEWER = "the time of the image is not after that of the one before"
_KEPT_FRAMES = 256  # frames that an ack may cite, as many as the gate records


class NetworkCore:
    """The logic of one network process.

    Args:
        config: flow of frames.
        session: session id of the robot.
        first_seq: first sequence number, the next one after an earlier process of this session.
        max_frame_bytes: limit for one image.
    """

    def __init__(self, config: StreamConfig, session: str, first_seq: int, max_frame_bytes: int) -> None:
        self.motion = RobotMotion()
        self._rejected_pictures = 0
        self.image_fault = ""
        """Why the newest image was rejected."""
        self._stream = Stream(config)
        self._session = session
        self._seq = first_seq
        self._max_frame_bytes = max_frame_bytes
        self._last_t_us = -1
        self._frame_times: dict[int, int] = {}
        """Number of a sent frame -> its capture time."""
        self._camera_seq: int | None = None
        self._camera_due_us = 0
        self._announced: CameraModel | None = None
        self._scale_percent = 100
        self._requested = EncodingTarget()
        self._applied = EncodingTarget()
        """Encoding of the camera. It does not change for a camera with its own JPEGs."""

    def may_capture(self, now_us: int, listening: bool) -> bool:
        """Return True if the camera may capture now."""
        return self._stream.may_capture(now_us, listening)

    def wait_us(self, now_us: int) -> int:
        """Return the time in us after which `may_capture` can change without an answer."""
        return self._stream.wait_us(now_us)

    def early_us(self, now_us: int) -> int:
        """Return the time in us until the next frame is due. Until then no answer changes `may_capture`."""
        return self._stream.early_us(now_us)

    def on_camera(self, picture: Picture, now_us: int) -> tuple[FrameHeader, Message] | None:
        """Make the frame of an image.

        Args:
            picture: the newest image.
            now_us: monotonic clock.

        Returns:
            Header and message. None for an image that is too large, not newer than the last one, or in the future; it
            is counted.
        """
        self.image_fault = self._fault_of(picture, now_us)
        if self.image_fault:
            self._rejected_pictures += 1
            return None
        self._last_t_us = picture.t_us
        self._scale_percent = picture.scale_percent
        header = self._header(picture.t_us)
        self._stream.on_sent(self._seq, picture.t_us, now_us, len(picture.jpeg))
        self._frame_times[self._seq] = picture.t_us
        self._frame_times.pop(self._seq - _KEPT_FRAMES, None)
        self._seq += 1
        return header, Message(FRAME, "", encode(header), picture.jpeg)

    def _fault_of(self, picture: Picture, now_us: int) -> str:
        """Return why an image cannot be sent, or ""."""
        if picture.t_us > now_us:  # otherwise no later frame would be newer until that time
            return f"image is {(picture.t_us - now_us) / 1e6:.3f} s in the future"
        if picture.t_us <= self._last_t_us:
            return _NOT_NEWER
        size_bytes = len(picture.jpeg)
        if size_bytes > self._max_frame_bytes:
            return f"image of {size_bytes} bytes; at most {self._max_frame_bytes} (max_frame_bytes)"
        return ""

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

    def on_command_ack(self, ack: CommandAck, now_us: int) -> None:
        """Return the credit of a validated twist to the holder of the lease."""
        self._stream.on_holder(ack.holder, now_us)
        # An answer to a frame that does not exist yet must not return credit.
        if ack.seq < self._seq:
            self._stream.on_answer(ack.sender, ack.seq, ack.compute_us, now_us)

    def on_ack(self, message: Message, now_us: int) -> None:
        """Return the credit of an acknowledgment. Raises WireError for an invalid one."""
        header = decode(AnswerHeader, message.header)
        if header.source == message.source and self._was_sent(header.echo):
            who = Holder(source=header.source, session=header.session)
            self._stream.on_answer(who, header.echo.seq, header.compute_us, now_us)

    def _was_sent(self, echo: Echo) -> bool:
        is_frame = echo.channel == FRAME.name and echo.session == self._session
        return is_frame and self._frame_times.get(echo.seq) == echo.t_us

    def adapt(self, camera: Camera) -> None:
        """Pass a new encoding target to a camera that can follow it. Repeat it while the camera is gone."""
        target = self._stream.encoding_target
        if target == self._requested or not isinstance(camera, Adjustable):
            return
        try:
            followed = camera.adjust(*target)
        except HardwareError:
            # `Camera.read` reports the error. The next call tries again, because `_requested` is unchanged.
            return
        self._requested = target
        if followed:
            self._applied = target

    def announce_camera(self, full_model: CameraModel, now_us: int) -> Message | None:
        """Return the model of the newest image, twice a second, and before the first frame of another model.

        Args:
            full_model: model of the camera at full size.
            now_us: monotonic clock.
        """
        model = scaled_model(full_model, self._scale_percent)
        if now_us < self._camera_due_us and (model is self._announced or model == self._announced):
            return None
        self._announced = model
        self._camera_due_us = now_us + _CAMERA_PERIOD_US
        # It starts at the current time, above the numbers of an earlier process of this session.
        self._camera_seq = now_us if self._camera_seq is None else self._camera_seq + 1
        stamp = Stamp(session=self._session, seq=self._camera_seq, t_us=now_us)
        return Message(CAMERA, "", encode(stamp), encode(model))

    def on_new_driver(self) -> None:
        """Send a frame and the camera model as soon as possible, for a new driver."""
        self._camera_due_us = 0
        self._stream.release()

    def status(
        self, now_us: int, dropped_commands: int = 0, dropped: Mapping[str, int] | None = None,
        missed_captures: int = 0, camera_fault: str = "",
    ) -> StreamStatus:
        """Return the counters of the stream and of the camera.

        Args:
            dropped: messages that the slots of the link dropped, by channel.
            missed_captures: images that the slot of the camera dropped.
            camera_fault: why no image comes.
        """
        stream = self._stream
        # A camera may repeat single images while other frames are sent.
        is_shown = self.image_fault != _NOT_NEWER or not stream.fps(now_us)
        counted = sorted(((name, count) for name, count in (dropped or {}).items() if count), key=lambda item: -item[1])
        return StreamStatus(
            sent=stream.sent,
            credit_timeouts=stream.credit_timeouts,
            window=stream.window,
            fps=stream.fps(now_us),
            dropped_commands=dropped_commands,
            refused_pictures=self._rejected_pictures,
            calibrated=self._announced is not None and self._announced.calibrated,
            overtaken=stream.overtaken,
            dropped=dict(counted[:MAX_CHANNELS_SHOWN]),
            missed_captures=missed_captures,
            quality_percent=self._applied.quality_percent,
            scale_percent=self._applied.scale_percent,
            camera_fault=(camera_fault or self.image_fault * is_shown)[:200],
        )


def _rounded(pair: Planar) -> Planar:
    return round(pair[0], 4), round(pair[1], 4)


def _rounded_pose(pose: Pose) -> Pose:
    return round(pose[0], 4), round(pose[1], 4), round(pose[2], 5)
