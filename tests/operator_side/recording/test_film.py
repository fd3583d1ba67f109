"""Films and snapshots: what ends them, and a full disk, which is one line and leaves no unfinished file."""

import errno
import json
import os
import re
import resource
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
import simplejpeg

from sightline.operator_side.cli import watch
from sightline.operator_side.client.pictures import Shot
from sightline.operator_side.recording.film import Captured, Cut, Film, check_target, film, record, snapshot
from sightline.operator_side.recording.recorder import RECORDED, read_about, read_recording
from sightline.protocol.channels import FRAME, OVERLAY, STATUS
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.link import Message
from tests.fixtures.commands import run

NOISE = simplejpeg.encode_jpeg(np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8), 90)


class Played:
    """Images of noise, which compress badly."""

    def __init__(self) -> None:
        self._shots = iter([Shot(FRAME, NOISE, "0000000a", at, at * 100_000, 160, 120) for at in range(1, 12)])

    def take(self, _seconds: float) -> Shot:
        return next(self._shots)


@contextmanager
def full_disk(room_bytes: int = 1000) -> Iterator[None]:
    """Let no file grow beyond that."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("room_bytes", [0, 1, 1000, 4000])
def test_video_on_a_full_disk_is_reported(tmp_path: Path, room_bytes: int) -> None:
    with full_disk(room_bytes), pytest.raises(ConfigError, match=f"cannot write {tmp_path}/run.mp4: File too large; "):
        film(Played(), tmp_path / "run.mp4", FRAME, 0.9)
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_ends_a_film_and_before_its_first_image_the_command(tmp_path: Path) -> None:
    class Interrupted(Played):
        left = 0

        def take(self, seconds: float) -> Shot:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            return super().take(seconds)

    with pytest.raises(KeyboardInterrupt):
        film(Interrupted(), tmp_path / "run.mp4", FRAME, 0.9)
    assert list(tmp_path.iterdir()) == []
    pictures = Interrupted()
    pictures.left = 2
    assert film(pictures, tmp_path / "run.mp4", FRAME, 0.9).frames == 2


@pytest.fixture
def hangs_up() -> Iterator[None]:
    """SIGHUP ends this process, also under `nohup`."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("hangs_up")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_film_is_kept_although_its_signal_comes_again(tmp_path: Path, number: signal.Signals) -> None:
    class Terminated(Played):
        def take(self, seconds: float) -> Shot:
            shot = super().take(seconds)
            if shot.seq > 3:
                signal.raise_signal(number)
            return shot

    ended = []
    close = Film.close

    def closed(made: Film) -> None:
        signal.raise_signal(number)  # a closed terminal and `timeout` send it again, or an impatient user
        ended.append(made)
        close(made)

    before = signal.getsignal(number)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Film, "close", closed)
        made = film(Terminated(), tmp_path / "run.mp4", FRAME, 0.9)
    assert (made.frames, made.cut, len(ended)) == (3, "interrupted", 1)
    assert [one.name for one in tmp_path.iterdir()] == ["run.mp4"] and signal.getsignal(number) is before


def test_hangup_that_nohup_ignores_ends_no_film(tmp_path: Path) -> None:
    class HungUp(Played):
        def take(self, seconds: float) -> Shot:
            signal.raise_signal(signal.SIGHUP)
            return super().take(seconds)

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert film(HungUp(), tmp_path / "run.mp4", FRAME, 0.9).frames == 10
    finally:
        signal.signal(signal.SIGHUP, before)


class Timed:
    """Images every 100 ms of a clock that only they advance, of the sessions and times on the robot's clock."""

    robot, is_online = "r1", True

    def __init__(self, monkeypatch: pytest.MonkeyPatch, shots: dict[int, tuple[str, int]]) -> None:
        self.now_ms, self._shots = 0, shots
        monkeypatch.setattr("time.monotonic", lambda: 7.0 + self.now_ms / 1000)

    def take(self, _seconds: float) -> Shot | None:
        self.now_ms += 100
        session, t_ms = self._shots.get(self.now_ms, ("", 0))
        return Shot(FRAME, NOISE, session, self.now_ms, t_ms * 1000, 160, 120) if session else None


@pytest.mark.parametrize("begins_ms", [30, 10_000_000])
def test_film_goes_on_after_a_restart_of_the_robots_clock(monkeypatch, tmp_path: Path, begins_ms: int) -> None:
    before = {at: ("0000000a", 5_000_000 + at) for at in range(100, 1001, 100)}
    after = {at: ("0000000b", begins_ms + at) for at in range(2000, 9001, 100)}
    made = film(Timed(monkeypatch, before | after), tmp_path / "run.mp4", FRAME, 3.0)
    assert made.frames == 10 + 12 and made.cut == "" and made.seconds == pytest.approx(3.0, abs=0.002)
    with av.open(str(tmp_path / "run.mp4")) as opened:
        times_s = [frame.time for frame in opened.decode(video=0)]
    gaps_s = np.diff(times_s)
    assert gaps_s.max() == pytest.approx(1.0, abs=0.002) and np.delete(gaps_s, 9) == pytest.approx(0.1, abs=0.002)


@pytest.mark.parametrize(("last_ms", "cut"), [(1000, "silent"), (2300, "")])
def test_film_whose_images_end_early_is_reported(monkeypatch, tmp_path: Path, last_ms: int, cut: str) -> None:
    shots = {at: ("0000000a", at) for at in range(100, last_ms + 1, 100)}
    made = film(Timed(monkeypatch, shots), tmp_path / "run.mp4", FRAME, 3.0)
    assert (made.frames, made.cut) == (last_ms // 100, cut)


@pytest.mark.parametrize(("at", "cut"), [(500, "silent"), (1900, "silent"), (2300, "")])
def test_film_that_a_wrong_capture_time_ends_early_is_reported(monkeypatch, tmp_path: Path, at: int, cut: str) -> None:
    shots = {one: ("0000000a", one if one < at else 10**9) for one in range(100, 4000, 100)}
    assert film(Timed(monkeypatch, shots), tmp_path / "run.mp4", FRAME, 3.0).cut == cut


@pytest.mark.parametrize(("cut", "lines"), [("", 0), ("interrupted", 0), ("silent", 1)])
def test_capture_names_a_video_that_is_not_complete(monkeypatch, capsys, tmp_path: Path, cut: Cut, lines: int) -> None:
    monkeypatch.setattr(watch, "open_link", lambda *_given, **_more: nullcontext())
    monkeypatch.setattr(watch, "Pictures", lambda *_given: None)
    monkeypatch.setattr("sightline.operator_side.recording.film.film",
                        lambda _pictures, path, *_given: Captured(path, 20, 2.0, 160, 120, cut))
    code, out, err = run(capsys, "capture", "r1", "--connect", "tcp/127.0.0.1:1", "--seconds", "8", "--json", "--out",
                         str(tmp_path / "run.mp4"))
    warnings = [line for line in err.splitlines() if "shorter than requested" in line]
    assert code == 0 and json.loads(out)["complete"] is (cut == "") and len(warnings) == lines
    assert all("after 2.0 s" in line for line in warnings)


def test_captures_of_one_second_have_names_of_their_own(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(watch, "open_link", lambda *_given, **_more: nullcontext())
    monkeypatch.setattr(watch, "Pictures", lambda *_given: Played())
    outcomes = [run(capsys, "capture", "r1", "--connect", "tcp/127.0.0.1:1") for _ in range(4)]
    assert [code for code, _, _ in outcomes] == [0] * 4
    names = [path.name for path in tmp_path.iterdir()]
    assert len(names) == 4 and all(re.fullmatch(r"r1-\d{8}-\d{6}-\d{6}\.png", name) for name in names)


def test_snapshot_on_a_full_disk_is_reported(tmp_path: Path) -> None:
    with full_disk(), pytest.raises(ConfigError, match=f"cannot write {tmp_path}/one.jpg: File too large; "):
        snapshot(Played(), tmp_path / "one.jpg", FRAME)
    assert list(tmp_path.iterdir()) == []


def test_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    for name in ("one.jpg", "one.png", "run.mp4"):
        link, file = tmp_path / name, tmp_path / "real" / name
        link.symlink_to(file)
        if name == "run.mp4":
            film(Played(), link, FRAME, 0.9)
        else:
            snapshot(Played(), link, FRAME)
        assert link.readlink() == file and file.stat().st_size > 0
    assert len(list(tmp_path.rglob("*"))) == 7


@pytest.mark.parametrize("name", ["pipe.jpg", "link.jpg", "pipe.mp4", "link.mp4", "pipe.mcap", "link.mcap"])
def test_device_or_pipe_is_never_replaced(tmp_path: Path, name: str) -> None:
    pipe = tmp_path / f"pipe{Path(name).suffix}"
    os.mkfifo(pipe)
    (tmp_path / f"link{pipe.suffix}").symlink_to(pipe)
    with os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK), "rb") as reader:
        if pipe.suffix != ".jpg":  # the index of a video is written into the part before
            with pytest.raises(ConfigError, match=f"cannot write {tmp_path / name}: it is a device or a pipe; name a"):
                check_target(tmp_path / name, None)
        else:
            check_target(tmp_path / name, None)
            snapshot(Played(), tmp_path / name, FRAME)
            assert reader.read() == NOISE
    assert pipe.is_fifo() and len(list(tmp_path.iterdir())) == 2


def test_two_videos_to_one_file_leave_a_whole_one(tmp_path: Path) -> None:
    path, images = tmp_path / "run.mp4", 80

    class Interrupting(Played):
        """While the encoder already writes, another program makes a video of the same name."""

        def __init__(self) -> None:
            self._shots = iter([Shot(FRAME, NOISE, "0000000a", at, at * 20_000, 160, 120) for at in range(images + 1)])
            self._taken = 0

        def take(self, seconds: float) -> Shot:
            self._taken += 1
            if self._taken == images - 5:
                film(Played(), path, FRAME, 0.9)
            return super().take(seconds)

    film(Interrupting(), path, FRAME, (images - 1.5) * 0.02)
    with av.open(str(path)) as file:
        assert len(list(file.decode(video=0))) == images - 1
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("count", [1, 2, 7, 10, 11, 17, 18])
def test_video_lasts_to_its_last_image(tmp_path: Path, count: int) -> None:
    gaps_ms = [68, 136, 68, 100, 136, 100, 68, 68, 136, 200, 68, 68, 100, 136, 100, 100, 168, 100][:count]
    times_us = [1000 * sum(gaps_ms[:at]) for at in range(count + 1)]
    floor = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8), (15, 15), 0)
    with Film(tmp_path / "run.mp4", 30) as made:
        for at, t_us in enumerate(times_us):
            made.add(np.roll(floor, at, 1), t_us)
    with av.open(str(tmp_path / "run.mp4")) as file:
        assert [frame.time for frame in file.decode(video=0)] == pytest.approx([at / 1e6 for at in times_us], abs=1e-4)
        assert file.duration / av.time_base > times_us[-1] / 1e6


@pytest.mark.parametrize("sizes_px", [[(161, 121)], [(160, 120), (80, 61)], [(1, 1), (160, 120)], [(2, 3), (5, 4)]])
def test_size_of_a_video_is_that_of_its_file(tmp_path: Path, sizes_px: list[tuple[int, int]]) -> None:
    with Film(tmp_path / "run.mp4", 30) as made:
        for at, (width_px, height_px) in enumerate(sizes_px):
            assert made.add(np.full((height_px, width_px, 3), 99, np.uint8), at * 100_000)
    with av.open(str(tmp_path / "run.mp4")) as file:
        assert {(frame.width, frame.height) for frame in file.decode(video=0)} == {made.size_px}


# --- recordings --------------------------------------------------------------------------------------------------


class Talking:
    """A link to a robot, and its images: each take delivers the next messages."""

    robot, is_online = "r1", True

    def __init__(self, *turns) -> None:
        self.callbacks, self._turns = {}, iter(turns)

    def subscribe(self, channel, callback) -> None:
        self.callbacks[channel] = callback

    def take(self, seconds: float) -> None:
        for turn in next(self._turns, ()):
            if isinstance(turn, Message):
                self.callbacks[turn.channel](turn)
            else:
                turn()
        assert seconds > 0


def status(number: int) -> Message:
    return Message(STATUS, "", b'{"seq":%d}' % number, b"{}")


@pytest.mark.parametrize("wanted", [FRAME, OVERLAY])
def test_recording_has_each_message_of_its_time(tmp_path: Path, wanted) -> None:
    path, messages = tmp_path / "run.mcap", [status(1), Message(FRAME, "", b"{}", NOISE), status(2)]
    robot = Talking(messages[:1], messages[1:])
    recorder, cut = record(robot, robot, path, wanted, 0.05)
    assert cut == ""
    assert set(robot.callbacks) == {*RECORDED, wanted}
    assert [one.message for one in read_recording(path)] == messages
    assert read_about(path) == {"robot": "r1"} and recorder.counts == {"status": 2, "frame": 1}


@pytest.mark.usefixtures("hangs_up")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ended_recording_is_kept(tmp_path: Path, number: signal.Signals) -> None:
    robot = Talking([status(1)], [status(2), lambda: signal.raise_signal(number)], [status(3)])
    before = signal.getsignal(number)
    assert record(robot, robot, tmp_path / "run.mcap", FRAME, 60.0)[1] == "interrupted"
    assert [one.message for one in read_recording(tmp_path / "run.mcap")] == [status(1), status(2)]
    assert signal.getsignal(number) is before


@pytest.mark.usefixtures("hangs_up")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("earlier", [b"earlier", None])
def test_recording_that_ends_before_its_first_message_ends_the_command(tmp_path: Path, number, earlier) -> None:
    path = tmp_path / "run.mcap"
    if earlier is not None:
        path.write_bytes(earlier)
    robot = Talking([lambda: signal.raise_signal(number)])
    with pytest.raises(KeyboardInterrupt):
        record(robot, robot, path, FRAME, 60.0)
    assert {one: one.read_bytes() for one in tmp_path.iterdir()} == ({path: earlier} if earlier else {})


def test_recording_without_its_package_is_an_error_and_leaves_no_file(monkeypatch, capsys, tmp_path: Path) -> None:
    robot = Talking([status(1)])
    monkeypatch.setattr(watch, "open_link", lambda *_given, **_more: nullcontext(robot))
    monkeypatch.setattr(watch, "Pictures", lambda *_given: robot)
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    code, _, err = run(capsys, "capture", "r1", "--connect", "tcp/127.0.0.1:1", "--out", str(tmp_path / "run.mcap"))
    assert code == 2 and "mcap is not installed: " in err
    assert list(tmp_path.iterdir()) == []


def test_recording_without_a_message_is_an_error_and_leaves_no_file(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr("sightline.operator_side.recording.film.PATIENCE_S", 0.01)
    with pytest.raises(LinkError, match=r"no image from robot 'r1' after 0\.01 s"):
        record(Talking(), Talking(), tmp_path / "run.mcap", FRAME, 60.0)
    assert list(tmp_path.iterdir()) == []


def test_recording_replaces_an_earlier_one_only_if_it_has_messages(monkeypatch, tmp_path: Path) -> None:
    path, link = tmp_path / "run.mcap", tmp_path / "link.mcap"
    path.write_bytes(b"earlier")
    link.symlink_to(path)
    with monkeypatch.context() as patch:
        patch.setattr("sightline.operator_side.recording.film.PATIENCE_S", 0.01)
        with pytest.raises(LinkError, match=r"no image from robot 'r1' after 0\.01 s"):
            record(Talking(), Talking(), link, FRAME, 60.0)
    assert path.read_bytes() == b"earlier"
    robot = Talking([status(1)])
    record(robot, robot, link, FRAME, 0.01)
    assert [one.message for one in read_recording(path)] == [status(1)]
    assert link.is_symlink() and set(tmp_path.iterdir()) == {path, link}


@pytest.mark.parametrize("earlier", [b"", b"earlier", None])
def test_second_recording_of_one_file_is_rejected_and_the_first_is_complete(tmp_path: Path, earlier) -> None:
    path = tmp_path / "run.mcap"
    if earlier is not None:
        path.write_bytes(earlier)

    def record_again() -> None:
        with pytest.raises(ConfigError, match=f"cannot write {path}: another recording writes it; name another file"):
            record(Talking([status(9)]), Talking([status(9)]), path, FRAME, 0.01)

    robot = Talking([status(1)], [record_again], [status(2)])
    record(robot, robot, path, FRAME, 0.1)
    assert [one.message for one in read_recording(path)] == [status(1), status(2)]
    assert list(tmp_path.iterdir()) == [path]
    record(robot := Talking([status(3)]), robot, path, FRAME, 0.01)
    assert [one.message for one in read_recording(path)] == [status(3)]


def test_recording_to_a_pipe_ends_with_one_line(tmp_path: Path) -> None:
    os.mkfifo(path := tmp_path / "run.mcap")
    with pytest.raises(ConfigError, match=f"recording {path} ends early: Illegal seek"):
        record(robot := Talking([status(1)]), robot, path, FRAME, 0.01)


def test_recording_needs_no_locks_of_the_file_system(monkeypatch, tmp_path: Path) -> None:
    def without_locks(*_given) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", without_locks)
    robot = Talking([status(1)])
    assert record(robot, robot, tmp_path / "run.mcap", FRAME, 0.01)[0].counts == {"status": 1}


def test_recording_has_its_length_from_the_first_message_on(tmp_path: Path) -> None:
    robot = Talking([lambda: time.sleep(0.2)], [status(1), lambda: time.sleep(0.03)])
    begin_s = time.monotonic()
    recorder, _ = record(robot, robot, tmp_path / "run.mcap", FRAME, 0.1)
    assert recorder.counts == {"status": 1} and 0.3 < time.monotonic() - begin_s < 3


def test_recording_on_a_full_disk_ends_with_one_line() -> None:
    robot = Talking(*[[Message(FRAME, "", b"{}", bytes(200_000))]] * 100)
    with pytest.raises(ConfigError, match="/dev/full ends early: No space left on device; free some space or name"):
        record(robot, robot, Path("/dev/full"), FRAME, 60.0)


@pytest.mark.parametrize("name", ["run.mcap", "link.mcap", ".run.mcap"])
def test_recording_on_a_full_disk_keeps_the_earlier_file_and_its_own_beginning(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    (tmp_path / "run.mcap").write_bytes(b"earlier")
    if name == "link.mcap":
        path.symlink_to(tmp_path / "run.mcap")
    elif name == ".run.mcap":
        path.write_bytes(b"earlier")
    there = set(tmp_path.iterdir())
    robot = Talking(*[[Message(FRAME, "", b"{}", os.urandom(200_000))]] * 30)
    with full_disk(3_000_000), pytest.raises(ConfigError) as failed:
        record(robot, robot, path, FRAME, 60.0)
    (kept,) = set(tmp_path.iterdir()) - there
    assert path.read_bytes() == b"earlier" and kept.suffix == ".mcap" and 5 <= len(list(read_recording(kept))) < 30
    assert str(failed.value) == (f"recording {kept} ends early: No space left on device; {path} is unchanged; "
                                 "free some space or name another file")
    assert kept.name.startswith(".") is (name == ".run.mcap")


class Clock:
    """Replaces the module `time` in film and recorder."""

    def __init__(self, monkeypatch) -> None:
        self.now_ms = 5_000
        for module in ("film", "recorder"):
            monkeypatch.setattr(f"sightline.operator_side.recording.{module}.time", self)

    def monotonic(self) -> float:
        return self.now_ms / 1000

    def monotonic_ns(self) -> int:
        return self.now_ms * 1_000_000

    time_ns = monotonic_ns

    def advance(self) -> None:
        self.now_ms += 100


@pytest.mark.parametrize(("last_ms", "cut"), [(0, "silent"), (100, "silent"), (1900, "silent"), (2000, ""), (3000, "")])
def test_recording_whose_messages_end_early_is_reported(monkeypatch, tmp_path: Path, last_ms: int, cut: Cut) -> None:
    clock = Clock(monkeypatch)
    turns = [[status(at)] * (at <= last_ms) + [clock.advance] for at in range(0, 9_000, 100)]
    recorder, found = record(robot := Talking(*turns), robot, tmp_path / "run.mcap", FRAME, 3.0)
    assert (recorder.seconds, found) == (last_ms / 1000, cut)


@pytest.mark.parametrize("overlay", [False, True])
@pytest.mark.parametrize("cut", ["", "interrupted", "silent"])
@pytest.mark.parametrize("dropped", [0, 3])
def test_capture_prints_what_it_recorded(
    monkeypatch, capsys, tmp_path: Path, overlay: bool, dropped: int, cut: Cut
) -> None:
    """The images of the recorder are always frames: taken overlays would end its subscription to frames."""
    file, robot, taken = tmp_path / "run.MCAP", Talking(), []
    monkeypatch.setattr(watch, "open_link", lambda *_given, **_more: nullcontext(robot))
    monkeypatch.setattr(watch, "Pictures", lambda _link, _role, first, _secure: taken.append(first) or robot)

    def recorded(*given):
        assert given == (robot, robot, file, OVERLAY if overlay else FRAME, 5.0)
        return SimpleNamespace(counts={"status": 2, "frame": 1}, dropped=dropped, seconds=2.0), cut

    monkeypatch.setattr("sightline.operator_side.recording.film.record", recorded)
    command = ("capture", "r1", "--connect", "tcp/127.0.0.1:1", "--out", str(file), *["--overlay"] * overlay)
    code, out, err = run(capsys, *command)
    assert (code, out) == (0, f"{file}: 3 messages of r1: frame 1, status 2\n") and taken == [FRAME]
    silent = ("capture: no more messages after 2.0 s, so the recording is shorter than requested; "
              "run `sightline status r1`")
    slow = f"capture: 3 messages are missing, because {file} is on a slow disk"
    assert err.splitlines() == [silent] * (cut == "silent") + [slow] * bool(dropped)
    assert json.loads(run(capsys, *command, "--json")[1]) == {
        "robot": "r1", "file": str(file), "messages": {"status": 2, "frame": 1}, "dropped": dropped,
        "seconds": 2.0, "complete": not (dropped or cut),
    }
