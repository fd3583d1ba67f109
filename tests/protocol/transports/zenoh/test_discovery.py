"""Discovery by multicast: it finds only robots that listen beyond loopback, and its failure breaks nothing."""

import os
import subprocess
import sys
import threading
from contextlib import closing

import pytest

from sightline.operator_side.client.discovery import DiscoveryReport, as_object, lines
from sightline.protocol.codec import encode
from sightline.protocol.messages import Stamp, State, Status
from sightline.protocol.transports.tokens import DetectorToken, DriverToken, RobotToken, VisionToken
from sightline.protocol.transports.zenoh import discovery
from sightline.protocol.transports.zenoh.discovery import (
    Discovered,
    PresentTokens,
    discover,
    find_listeners,
    usable_endpoint,
)
from sightline.protocol.transports.zenoh.link import declare_token
from sightline.protocol.transports.zenoh.presence import MAX_PEERS, PeerInfo, Presence
from sightline.protocol.transports.zenoh.session import MULTICAST_OFF, multicast_section, open_session, session_config
from tests.fixtures.ports import free_endpoint

INSIDE = """
import fcntl, os, socket, struct, subprocess, sys
from sightline.operator_side.cli import app as cli
from sightline.protocol.transports.zenoh.session import MULTICAST_GROUP as GROUP

ROBOT = '''
import sys, time
from sightline.protocol.transports.zenoh.link import open_zenoh
with open_zenoh(sys.argv[2], listen=[sys.argv[1]], role="robot"):
    print("on", flush=True)
    time.sleep(60)
'''
tap = os.open("/dev/net/tun", os.O_RDWR)  # an interface is up while a process holds its other end
fcntl.ioctl(tap, 0x400454CA, struct.pack("16sH22x", b"tap", 0x1002))  # TUNSETIFF, IFF_TAP | IFF_NO_PI
for command in ("link set lo up", "link set tap up", "addr add 10.9.8.1/24 dev tap",
                "route add 224.0.0.0/4 dev tap"):
    subprocess.run(["ip", *command.split()], check=True)

def robot(endpoint, name):
    process = subprocess.Popen([sys.executable, "-c", ROBOT, endpoint, name], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "on\\n"
    return process

running = [robot("tcp/0.0.0.0:7701", "r1"), robot("tcp/10.9.8.1:7702", "r2"), robot("tcp/127.0.0.1:7703", "r3")]
cli.run(["robots"])
for process in running:
    process.kill()
    process.wait()
with socket.socket(type=socket.SOCK_DGRAM) as taken:
    taken.bind(("", GROUP[1]))
    last = robot("tcp/0.0.0.0:7704", "r4")
    cli.run(["robots", "--connect", "tcp/127.0.0.1:7704"])
    last.kill()
"""


@pytest.mark.parametrize("listen", [(), ("tcp/127.0.0.1:7447",), ("tls/localhost:1", "tcp/[::1]:2")])
def test_loopback_listener_does_not_answer_multicast(listen):
    assert multicast_section(listen) == MULTICAST_OFF


@pytest.mark.parametrize("listen", [("tcp/0.0.0.0:7447",), ("tcp/127.0.0.1:1", "quic/192.168.1.20:2"), ("tcp/[::]:1",)])
def test_network_listener_answers_in_its_own_group_and_never_connects(listen):
    section = multicast_section(listen)
    assert section["enabled"] and section["listen"]
    assert section["address"] == "224.0.0.224:7449"  # Zenoh's own is 7446
    assert not any(section["autoconnect"].values())
    assert session_config(listen, (), 1.0)["scouting"]["multicast"] == section


@pytest.mark.parametrize(("locator", "endpoint"), [
    ("tcp/10.0.0.7:7447#so_sndbuf=1", "tcp/10.0.0.7:7447"), ("tcp/[fd00::2]:7447?rel=1", "tcp/[fd00::2]:7447"),
    ("tcp/[fe80::2%3]:7447", ""), ("unixsock-stream/x", ""),
])  # fmt: skip
def test_listener_is_found_at_an_address_that_is_valid_on_this_machine_too(locator, endpoint):
    assert usable_endpoint(locator) == endpoint


def test_empty_network_has_no_listeners():
    assert [one for one in find_listeners(0.1) if one.startswith("tcp/127.")] == []


def _can_have_a_network_of_its_own():
    return os.geteuid() == 0 and subprocess.run(["unshare", "-n", "true"], check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not _can_have_a_network_of_its_own(), reason="no network namespaces; run the tests as root")
def test_two_robots_on_a_network_are_found_despite_a_used_group_port():
    """Two robots listen on a namespace's address, a third on loopback. Then another socket has the group's port."""
    command = ["unshare", "-n", "--kill-child", sys.executable, "-c", INSIDE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert [line.partition("  sightline")[0] for line in done.stdout.splitlines()] == [
        "tcp/10.9.8.1:7701: robot     r1: no status",
        "tcp/10.9.8.1:7702: robot     r2: no status",
        "robot     r4: no status",
    ], done


def test_every_robot_with_a_token_is_listed_and_the_others_are_counted():
    tokens = PresentTokens()
    for number in range(discovery.MAX_ROBOTS + 3):
        tokens.note(RobotToken(f"r{number}"), True)
        tokens.note(DriverToken(f"r{number}", "a", "0" * 32), True)
    for number in range(discovery.MAX_SERVICES + 3):
        tokens.note(VisionToken(f"v{number}", 1.0, "0000000a"), True)
    tokens.note(DetectorToken("0a1b2c3d", 1.0, "0000abcd"), True)
    tokens.note(RobotToken("r0"), True)
    assert len(tokens.all()) == 2 * discovery.MAX_ROBOTS + discovery.MAX_SERVICES and tokens.left_out == 3
    tokens.note(RobotToken("r10001"), False)
    tokens.note(RobotToken("r0"), False)
    assert tokens.left_out == 2
    for _ in range(3):
        tokens.note(RobotToken("r10002"), False)
    assert tokens.left_out == 0, "also if an end is reported twice"


def test_lines_of_many_robots_end_with_what_is_left_out():
    robots = frozenset(RobotToken(f"r{number}") for number in range(500))
    found = Discovered({}, [], robots, 7)
    said = list(lines(found))
    assert len(said) == 501 and said[-1] == f"7 more robots are not listed; the limit is {discovery.MAX_ROBOTS}"
    assert len(as_object(found)["robots"]) == 500 and as_object(found)["left_out"] == 7
    whole = DiscoveryReport({"a": found, "b": found}).as_object()
    assert len(whole["robots"]) == 1000 and whole["left_out"] == 14


def test_robots_beyond_the_limit_of_peers_have_no_version_and_a_line_names_the_limit():
    peers = [PeerInfo(Presence(role="robot", robot=f"r{number}", session=f"{number:08x}"), 0, 0)
             for number in range(MAX_PEERS)]
    robots = frozenset(RobotToken(f"r{number}") for number in range(MAX_PEERS + 1))
    assert len(list(lines(Discovered({}, peers[:-1], robots)))) == MAX_PEERS + 1
    said = list(lines(Discovered({}, peers, robots)))
    assert len(said) == MAX_PEERS + 2 and f"robot     r{MAX_PEERS}: no status  (no version reported)" in said
    assert said[-1] == f"{MAX_PEERS} peers are listed, which is the limit; versions of other robots are not known"


def test_all_robots_of_a_large_site_are_found_by_status_and_token():
    endpoint, done = free_endpoint(), threading.Event()
    header, status = encode(Stamp(session="0000abcd", seq=1, t_us=1)), encode(Status(state=State.HOLD, reason="test"))

    def publish():
        while not done.wait(0.1):
            for number in range(300):
                site.put(f"sightline/r{number}/status", status, attachment=header)

    with closing(open_session([endpoint], (), 5.0)) as site:
        declared = [declare_token(site, RobotToken(f"r{number}")) for number in range(100, 400)]
        thread = threading.Thread(target=publish)
        thread.start()
        try:
            found = discover([endpoint], 0.6)
        finally:
            done.set()
            thread.join()
    assert len(found.statuses) == len(found.tokens) == len(declared) == 300 and found.left_out == 0
    assert sum(line.startswith("robot ") for line in lines(found)) == 400
