"""The V4L2 camera: formats, times, damage, unplugging, freezing; and why a device cannot be used, on real nodes."""

import os
import stat
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import pytest

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.log import faults
from sightline.robot_side.config import PluginChoice
from sightline.robot_side.hardware.cameras.timing import CaptureClock, Clocks
from sightline.robot_side.hardware.cameras.v4l2 import V4l2Camera, check_device, device_owner, open_error, whole_jpeg
from sightline.robot_side.plugins import CAMERAS
from tests.contracts.cameras import next_picture
from tests.fixtures.cameras import FakeDevice, jpeg

pytestmark = pytest.mark.waits


@pytest.fixture
def node(tmp_path):
    """Stands for /dev/video0: there as long as the camera is plugged in."""
    (tmp_path / "video0").touch()
    return tmp_path / "video0"


@pytest.fixture
def opened(node):
    cameras = []

    def opening(device, **options):
        cameras.append(V4l2Camera(V4l2Camera.Config(device=node, **options), device.open))
        return cameras[-1]

    yield opening
    for camera in cameras:
        camera.close()


def eventually(condition, timeout_s=5.0):
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, "did not happen"
        time.sleep(0.01)


def age_of(picture) -> float:
    return time.monotonic() - picture.t_us / 1e6


def ages_of(camera) -> list[float]:
    """The ages of some images: on a busy machine one may wait, the youngest did not."""
    return [age_of(next_picture(camera)) for _ in range(5)]


def fault_of(camera, timeout_s=5.0) -> str:
    """The line of the next HardwareError."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        try:
            camera.read(0.05)
        except HardwareError as error:
            return str(error)
    raise AssertionError("no fault")


# --- pictures ----------------------------------------------------------------------------------------------------


def test_the_cameras_own_jpeg_passes_through_undecoded(opened):
    given = []
    device = FakeDevice(damage=lambda data: given.append(data) or data)
    picture = next_picture(opened(device))
    assert picture.jpeg in given


def test_padding_after_the_image_is_cut_off(opened):
    picture = next_picture(opened(FakeDevice(damage=lambda data: data + bytes(5000))))
    assert picture.jpeg.endswith(b"\xff\xd9")


def test_a_damaged_image_is_left_out(opened):
    device = FakeDevice()
    camera = opened(device)
    device.damage = lambda data: data[:-200]
    eventually(lambda: camera.read(0.05) is None)
    device.damage = lambda data: data
    assert next_picture(camera).jpeg.endswith(b"\xff\xd9")


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", b"\xff\xd9", jpeg()[1:], jpeg()[:-2], bytes(100)])
def test_image_without_its_beginning_or_end_is_invalid(data):
    assert whole_jpeg(data) is None


def test_images_are_copied_only_for_a_reader(opened):
    device = FakeDevice()
    camera = opened(device)
    next_picture(camera)
    time.sleep(1.1)
    before = device.retrieved, device.grabbed
    eventually(lambda: device.grabbed > before[1] + 5)
    assert device.retrieved == before[0]
    assert age_of(next_picture(camera)) < 1.0, "taken since"
    assert min(ages_of(camera)) < 0.1


# --- formats -----------------------------------------------------------------------------------------------------


def test_yuyv_is_rejected_unless_requested(opened):
    device = FakeDevice(formats=["YUYV"])
    with pytest.raises(HardwareError, match=r'gives YUYV, not MJPG: set camera\.options\.format = "YUYV"'):
        opened(device)
    assert device.is_released()
    assert next_picture(opened(device, format="YUYV")).jpeg[:2] == b"\xff\xd8"


def test_another_format_is_named(opened):
    with pytest.raises(HardwareError, match="gives GREY, not MJPG"):
        opened(FakeDevice(formats=["GREY"]))


def test_a_size_that_the_camera_does_not_have_is_named(opened):
    with pytest.raises(HardwareError, match="gives 640x480, not 800x600"):
        opened(FakeDevice(), width_px=800, height_px=600)


def test_model_of_another_size_is_rejected_and_the_device_released(opened):
    device = FakeDevice()
    model = {"width_px": 320, "height_px": 240, "fx_px": 200.0, "fy_px": 200.0, "cx_px": 160.0, "cy_px": 120.0}
    with pytest.raises(ConfigError, match="for 320x240, the camera delivers 640x480"):
        opened(device, model=model)
    assert device.is_released()


# --- times -------------------------------------------------------------------------------------------------------


NOW = Clocks(running_us=10_000_000, boot_us=500_000_000, day_us=1_700_000_000_000_000)


@pytest.mark.parametrize("clock", [time.monotonic, time.time, lambda: time.clock_gettime(time.CLOCK_BOOTTIME)])
def test_buffer_time_is_converted_to_the_monotonic_clock(opened, clock):
    camera = opened(FakeDevice(clock=lambda: clock() - 0.040))
    assert 0.040 <= min(ages_of(camera)) < 0.140


def test_image_without_a_time_has_the_configured_age(opened):
    camera = opened(FakeDevice(clock=lambda: 0.0), delay_ms=70)
    assert 0.070 <= min(ages_of(camera)) < 0.170


@pytest.mark.parametrize(
    ("stamp_us", "age_us"),
    [
        (9_900_000, 100_000),  # monotonic
        (10_000_000, 0),  # this very moment
        (8_000_000, 2_000_000),  # as old as is believed
        (7_999_999, 30_000),  # older: by the configured delay
        (10_000_001, 30_000),  # from the future
        (0, 30_000),  # none
        (500_000_000 - 50_000, 50_000),  # time since boot
        (1_700_000_000_000_000 - 50_000, 50_000),  # time of the day
    ],
)
def test_stamp_is_read_on_its_own_clock(stamp_us, age_us):
    assert CaptureClock(30_000).captured_us(stamp_us, NOW) == NOW.boot_us - age_us


@pytest.mark.parametrize("clock_us", [NOW.running_us, NOW.boot_us, NOW.day_us])
@pytest.mark.parametrize("age_us", [0, 2_000_000, 2_000_001, 9_000_000])
def test_later_stamps_of_a_known_clock_are_accepted_at_any_age(clock_us, age_us):
    stamps = CaptureClock(30_000)
    stamps.captured_us(clock_us - 10_000, NOW)
    assert stamps.captured_us(clock_us - age_us, NOW) == NOW.boot_us - age_us
    assert stamps.captured_us(clock_us - 10_000, NOW) == NOW.boot_us - 10_000, "and is not forgotten"


def test_future_stamp_counts_as_another_clock_or_is_ignored():
    """Monotonic time and time since boot are one until the machine is first put to sleep."""
    stamps = CaptureClock(30_000)
    awake = Clocks(running_us=9_000_000, boot_us=9_000_000, day_us=1_700_000_000_000_000)
    assert stamps.captured_us(8_990_000, awake) == 8_990_000
    assert stamps.captured_us(NOW.boot_us - 10_000, NOW) == NOW.boot_us - 10_000
    assert stamps.captured_us(NOW.boot_us - 3_000_000, NOW) == NOW.boot_us - 3_000_000
    assert stamps.captured_us(NOW.boot_us + 1, NOW) == NOW.boot_us - 30_000


def test_image_from_before_a_suspend_is_as_old_as_the_suspend():
    """The clock of most drivers stops in suspend, so their stamp of such an image looks young."""
    stamps, asleep_us = CaptureClock(30_000), 60_000_000
    assert stamps.captured_us(9_990_000, NOW) == NOW.boot_us - 10_000
    awake = Clocks(boot_us=500_100_000 + asleep_us, running_us=10_100_000, day_us=0)
    for stamp_us in (10_030_000, 10_099_000, 10_100_000):
        assert awake.boot_us - stamps.captured_us(stamp_us, awake) >= asleep_us
    later = Clocks(boot_us=500_200_000 + asleep_us, running_us=10_200_000, day_us=0)
    assert later.boot_us - stamps.captured_us(10_100_000, later) >= asleep_us
    assert stamps.captured_us(10_100_001, later) == later.boot_us - 99_999


def test_images_that_waited_for_a_stalled_process_are_old(opened):
    delay_s = [0.040]
    camera = opened(FakeDevice(clock=lambda: time.monotonic() - delay_s[0]))
    assert min(ages_of(camera)) < 0.140
    delay_s[0] = 5.0
    eventually(lambda: age_of(next_picture(camera)) > 4.9, 2.0)


# --- faults while driving ----------------------------------------------------------------------------------------


def test_unplugged_and_plugged_in_again(opened, node):
    device = FakeDevice()
    camera = opened(device)
    next_picture(camera)
    device.present = False
    node.unlink()
    assert fault_of(camera) == f"camera {node} was unplugged; plug it in again"
    assert device.is_released()
    device.present = True
    node.touch()
    eventually(lambda: fault_free(camera))
    assert len(device.opened) == 2


def fault_free(camera):
    try:
        return camera.read(0.1)
    except HardwareError:
        return None


def test_a_frozen_camera_is_reported_and_recovers(opened):
    device = FakeDevice()
    camera = opened(device)
    next_picture(camera)
    device.frozen = True
    assert "delivers no image" in fault_of(camera)
    device.frozen = False
    eventually(lambda: fault_free(camera))


def test_error_of_opencv_is_logged_and_ends_nothing(opened):
    device = FakeDevice()
    camera = opened(device)

    def raising(data):
        raise cv2.error("Bad input\nroi")

    device.damage = raising
    assert fault_of(camera).endswith("failed: Bad input roi") and faults()["camera"] >= 1
    device.damage = lambda data: data
    eventually(lambda: fault_free(camera))


def test_camera_with_invalid_data_is_reported(opened):
    device = FakeDevice()
    camera = opened(device, frozen_after_s=0.3)
    device.damage = lambda data: bytes(100)
    assert "no usable image for 0.3 s" in fault_of(camera)


def test_a_camera_that_starts_slowly_is_waited_for(opened):
    assert min(ages_of(opened(FakeDevice(starting_s=1.5)))) < 0.15


def test_camera_frozen_from_the_start_does_not_open(opened):
    device = FakeDevice(frozen=True)
    with pytest.raises(HardwareError, match="delivers no image"):
        opened(device)
    assert device.is_released()


# --- why a device cannot be used: real nodes ---------------------------------------------------------------------


def test_absent_device_lists_the_existing_devices(tmp_path):
    with pytest.raises(HardwareError, match=r"video9 is not there \((there are|no /dev/video\*)"):
        CAMERAS.build(PluginChoice(kind="v4l2", options={"device": str(tmp_path / "video9")}))


def test_a_plain_file_is_not_a_camera(tmp_path):
    (tmp_path / "video0").write_bytes(b"x")
    with pytest.raises(HardwareError, match="is not a camera device"):
        check_device(tmp_path / "video0")


def test_a_device_that_is_not_a_camera_does_not_open():
    with pytest.raises(HardwareError, match=r"/dev/random does not open"):
        CAMERAS.build(PluginChoice(kind="v4l2", options={"device": "/dev/random"}))


def test_no_permission_names_the_group_and_the_command():
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        node = Path(folder) / "video0"
        node.touch(0)
        node.chmod(0)
        uid = os.geteuid()
        if uid == 0:  # root may open anything
            os.seteuid(65534)
        try:
            with pytest.raises(HardwareError, match=r"group '(\w+)': sudo usermod -aG \1 \$USER"):
                check_device(node)
        finally:
            os.seteuid(uid)
        assert stat.S_IMODE(node.stat().st_mode) == 0


def test_busy_device_names_its_process(node):
    hold = f"import sys; held = open({str(node)!r}); print('held', flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline()
        assert device_owner(node).endswith(f"(pid {process.pid})")
        assert f"(pid {process.pid}) has it open" in str(open_error(node))
        process.stdin.close()
    assert device_owner(node) == ""
