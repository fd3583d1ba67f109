"""Discovery by multicast: it finds only robots that listen beyond loopback, and its failure breaks nothing."""

import os
import subprocess
import sys

import pytest

from sightline.protocol.transports.zenoh.discovery import find_listeners
from sightline.protocol.transports.zenoh.session import MULTICAST_OFF, multicast_section, session_config

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
