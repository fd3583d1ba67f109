"""A camera as the stream sees it: told how to encode, and with which model its last picture was taken. Pure."""

from collections.abc import Mapping

from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import MAX_CHANNELS_SHOWN, CameraModel, StreamStatus
from sightline.robot_side.network.bitrate_control import EncodingTarget
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
