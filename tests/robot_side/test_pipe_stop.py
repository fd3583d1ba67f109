"""A STOP that reached the robot's machine reaches the gate: through a full socket, and past a process that dies."""

import os
import signal
import socket
import time

import pytest

from sightline.protocol.channels import REQUEST, STATUS, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.messages import Request, RequestHeader, Verb
from sightline.protocol.transports.link import Message, OutgoingQueue
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.robot_side import pipe
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.pipe import MAX_PACKET_BYTES, MAX_PENDING, DriverEnd, NetworkEnd
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess, Vision, driving


def request(verb, source="operator", number=1):
    header = RequestHeader(source=source, session="0a0a0a0a", seq=number)
    return Message(REQUEST, source, encode(header), encode(Request(id=number, verb=verb)))


def put(waiting, message):
    return waiting.put(message, message)


class Room:
    """A socket with so many places left."""

    def __init__(self, places):
        self.places, self.sent = places, []

    def send(self, message):
        self.places -= 1
        if self.places >= 0:
            self.sent.append(message)
        return self.places >= 0


def test_waiting_requests_are_sent_with_room_and_stop_first():
    waiting = OutgoingQueue(MAX_PENDING)
    arm, stop = request(Verb.ARM), request(Verb.STOP)
    assert put(waiting, arm) and put(waiting, stop) and len(waiting) == 2
    room = Room(1)
    assert not waiting.flush(room.send) and room.sent == [stop] and len(waiting) == 1
    room = Room(5)
    assert waiting.flush(room.send) and room.sent == [arm] and waiting.flush(room.send) and room.sent == [arm]


def test_the_newest_of_one_source_and_verb_waits():
    waiting, room = OutgoingQueue(MAX_PENDING), Room(9)
    old, new = request(Verb.RESET, number=1), request(Verb.RESET, number=2)
    assert put(waiting, old) and put(waiting, new) and waiting.flush(room.send)
    assert room.sent == [new]


@pytest.mark.parametrize("first", [Verb.ARM, Verb.STOP])
def test_waiting_requests_are_bounded_and_a_stop_has_a_place(first):
    waiting, room = OutgoingQueue(MAX_PENDING), Room(99)
    for number in range(MAX_PENDING):
        assert put(waiting, request(first, f"source{number}"))
    assert not put(waiting, request(Verb.ARM, "another")) and len(waiting) == MAX_PENDING
    assert put(waiting, request(Verb.STOP, "another")) and len(waiting) == MAX_PENDING
    assert waiting.flush(room.send) and room.sent[0].payload == request(Verb.STOP).payload
    assert request(Verb.STOP, "another") in room.sent


def test_invalid_requests_are_dropped_when_there_is_no_room():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    end = NetworkEnd(ours, theirs)
    while end.send(b"full"):
        pass
    end.forward(Message(REQUEST, "operator", b"", b"{"))
    assert end.dropped_commands == 1
    end.forward(request(Verb.ARM))
    assert end.dropped_commands == 1
    ours.close()
    theirs.close()


# --- the driver's end --------------------------------------------------------------------------------------------


@pytest.fixture
def child(tmp_path):
    made = DriverEnd(RobotConfig(state_dir=tmp_path), "0a0a0a0a")
    yield made
    made.close()


def test_packets_of_a_dead_process_are_read_after_unread_ones(child):
    """The kernel reports unread packets ahead of the waiting ones, once."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    child.socket = ours
    child.on_ready()
    child.send(b"never read")
    theirs.send(b"STOP")
    theirs.close()
    assert list(child.packets()) == [b"STOP"]
    assert child.socket is None


def test_a_process_gets_nothing_from_before_it_is_ready_however_often_it_starts(child, monkeypatch):
    """It would publish a status of then as if it were new, and an operator would cite it."""

    class Starting:
        returncode = None

        def __init__(self, _command, pass_fds, **_):
            self.end = socket.socket(fileno=os.dup(pass_fds[0]))

        def poll(self):
            return self.returncode

        def kill(self):
            self.returncode = -9

        wait = kill

    monkeypatch.setattr(pipe.subprocess, "Popen", Starting)
    for now_us in range(0, 40_000_000, 10_000_000):
        child.keep_alive(now_us, 0)
        process = child._process
        child.send(b"status of before")
        child.on_ready()
        child.send(b"status")
        assert process.end.recv(MAX_PACKET_BYTES).startswith(b"{"), "its configuration"
        assert process.end.recv(MAX_PACKET_BYTES) == b"status"
        process.end.close()
        process.kill()
        list(child.packets())
        child.keep_alive(now_us + 1, 0)


def test_a_dead_process_is_not_forgotten_before_all_it_sent_is_read(child):
    child.keep_alive(0, 0)
    process, end = child._process, child.socket
    child.on_ready()
    process.kill()
    process.wait()
    child.keep_alive(1_000, 0)
    assert child.socket is end, "its packets are still to be read"
    assert list(child.packets()) == [] and child.socket is None
    child.keep_alive(2_000, 0)
    assert child._process is None


def test_dead_process_with_a_descendant_on_the_socket_is_restarted(child):
    child.keep_alive(0, 0)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    child.socket.close()
    child.socket = ours
    child.on_ready()
    child._process.kill()
    child._process.wait()
    for now_us in (1_000, 2_000_000):
        child.keep_alive(now_us, 0)
    assert child._process is None and child.socket is None
    theirs.close()


def silence_us(child, begin_us, step_us):
    """Keep a silent process alive every `step_us` from `begin_us` on, and return its silence when it was killed."""
    for now_us in range(begin_us + step_us, begin_us + 60_000_000, step_us):
        child.keep_alive(now_us, 0)
        if child._process.killed:
            return now_us - begin_us
    return None


@pytest.fixture
def silent(child, monkeypatch):
    """A child whose process is ready, and sends nothing after time 0."""
    monkeypatch.setattr(child, "_start", lambda _first_seq: None)
    child.keep_alive(0, 0)
    child._process = FakeProcess()
    child.on_ready()
    child._received = True
    child.keep_alive(0, 0)
    return child


class FakeProcess:
    """A process that runs until it is killed."""

    killed, returncode = False, None

    def poll(self):
        return self.returncode

    def kill(self):
        self.killed, self.returncode = True, -9

    def wait(self):
        pass


@pytest.mark.parametrize("step_us", [2_000, 20_000, 40_000])
def test_silent_network_process_is_killed_after_2_s(silent, step_us, caplog):
    caplog.set_level("INFO", "sightline")
    assert silence_us(silent, 0, step_us) == 2_000_000 + step_us
    for now_us in (3_000_000, 4_000_000):
        silent.keep_alive(now_us, 0)
    assert caplog.messages == ["network process ended (stopped or hung); starting it again"]


@pytest.mark.parametrize("pause_us", [2_500_000, 60_000_000])
def test_time_in_which_the_driver_process_did_not_run_does_not_count_as_silence(silent, pause_us):
    """A busy machine stops both, and the driver process may run first afterward."""
    for now_us in range(0, 1_900_000, 20_000):
        silent.keep_alive(now_us, 0)
    silent.keep_alive(1_900_000 + pause_us, 0)
    assert not silent._process.killed
    silent._received = True
    silent.keep_alive(2_000_000 + pause_us, 0)
    assert silence_us(silent, 2_000_000 + pause_us, 100_000) == 5_100_000, "40 ms of each 100 ms count"


# --- whole -------------------------------------------------------------------------------------------------------


@pytest.fixture
def stopped(tmp_path):
    """A robot at speed with a stopped driver process, and an operator that can send to it."""
    with RobotProcess(tmp_path, guarded=False) as robot, Vision(robot.endpoint) as vision:
        assert driving(robot)
        with open_zenoh("r1", connect=[robot.endpoint], role="operator", timeout_s=10) as link:
            assert link.latest(STATUS).take(5.0)
            robot.process.send_signal(signal.SIGSTOP)
            yield robot, vision, link


def say_stop_once(link):
    stop = request(Verb.STOP)
    link.publish(REQUEST, stop.header, stop.payload)
    time.sleep(1.0)  # until it has arrived: no event shows it while the driver process is stopped


def test_stop_sent_once_arrives_through_a_full_socket(stopped):
    robot, vision, link = stopped
    for _ in range(40):  # in pieces: what a busy machine cannot send at once is dropped before the robot sees it
        for _ in range(50):
            link.publish(TWIST, b"{", b"0.1|0", "vision")
        time.sleep(0.02)
    say_stop_once(link)
    robot.process.send_signal(signal.SIGCONT)
    assert until(lambda: vision.status().state == "STOPPED", 5)
    full = until(lambda: vision.status().stream.dropped_commands > 0, 3)  # the next report of the network process
    assert full, "the socket was never full: this proves nothing"
    assert until(lambda: robot.speed() == 0.0, 2)


def test_stop_sent_once_is_applied_after_the_network_process_dies(stopped):
    robot, _, link = stopped
    say_stop_once(link)
    robot.kill_network()
    robot.process.send_signal(signal.SIGCONT)
    assert until(lambda: "STOPPED (STOP by operator)" in robot.output(), 3)
    assert until(lambda: robot.speed() == 0.0, 2)
