"""Run the JavaScript peers in virtual time in one Node process, with or without a change of a file. Shell (a process).

`JsPeers` starts Node once. Each peer is new, from the modules of a folder: examples/js, or a copy with one change.
"""

import base64
import json
import shutil
import subprocess
from pathlib import Path

from sightline.conformance.benches import FROM_ROBOT, TO_ROBOT, VirtualBench
from sightline.protocol.channels import ACK, CHANNELS, FRAME, REQUEST, TWIST, key_for
from sightline.protocol.codec import encode
from sightline.protocol.transports.memory import MemoryNetwork
from tests.conformance.robot.reference import MODEL
from tests.conformance.vision.fixture import KEYS
from tests.fixtures.javascript import EXAMPLES, node
from tests.fixtures.robot_process import JPEG

SHELL = Path(__file__).with_name("virtual_peer.mjs")
WANTS = {"robot": (TWIST, ACK, REQUEST), "vision": FROM_ROBOT}
CAMERA = json.loads(encode(MODEL))


_ENDING = []
"""Processes that end by themselves; the interpreter collects them at its own end."""


class PeerFailedError(Exception):
    """The JavaScript of a peer raised an error; the text is its message."""


class JsPeers:
    """Run a Node process until the end of the block: `with JsPeers() as node`."""

    def __enter__(self):
        self._process = subprocess.Popen([node(), str(SHELL)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        return self

    def __exit__(self, *_raised):
        # Node ends with its input. Waiting for it here would add its CPU time to that of the last test.
        self._process.stdin.close()
        self._process.stdout.close()
        _ENDING.append(self._process)

    def call(self, **fields):
        """Send one line and return what the peer sends."""
        self._process.stdin.write(json.dumps(fields).encode() + b"\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        if "error" in answer:
            raise PeerFailedError(answer["error"])
        return answer["out"]


class JsPeer:
    """A JavaScript robot or vision service as a peer of a network in memory."""

    def __init__(self, peers, network, side, folder=EXAMPLES):
        self.network, self._peers, self._robot = network, peers, side == "robot"
        self.link = network.link("r1", role="" if self._robot else "vision")
        options = {"session": "00000001", "now_us": network.now_us}
        if self._robot:
            options |= {"jpeg": _text(JPEG), "camera": CAMERA, "limits": {"guests": True}}
        peers.call(do=side, folder=str(folder), **options)
        self._arrived = []
        for channel in WANTS[side]:
            self.link.subscribe(channel, self._receive)

    def _receive(self, message):
        """Pass a message on to a robot. Store it for a vision service until its turn, where the newest frame counts."""
        if self._robot:
            self._pass_on(message, self.network.now_us)
        else:
            self._arrived.append(message)

    def _pass_on(self, message, now_us):
        fields = {"channel": message.channel.name, "source": message.source}
        parts = {"header": _text(message.header), "payload": _text(message.payload)}
        self._send(self._peers.call(do="message", now_us=now_us, **fields, **parts))

    def tick(self, now_us):
        """Run one turn of the peer."""
        arrived, self._arrived = self._arrived, []
        for message in arrived:
            self._pass_on(message, now_us)
        self._send(self._peers.call(do="tick", now_us=now_us, wanted=self.link.has_listener(FRAME)))

    def _send(self, messages):
        for name, source, header, payload in messages:
            key = key_for("r1", CHANNELS[name], source)
            self.network.put(key, base64.b64decode(header), base64.b64decode(payload), self.link)


def _text(data):
    return base64.b64encode(data).decode("ascii")


def virtual_js(peers, side, folder=EXAMPLES):
    """Return (bench, peer): a new peer, and the kit connected to it."""
    network = MemoryNetwork()
    network.advance(1_000_000)
    peer = JsPeer(peers, network, side, folder)
    if side == "robot":
        return VirtualBench(network, [peer], FROM_ROBOT), peer
    return VirtualBench(network, [peer], TO_ROBOT, access=KEYS), peer


def changed_copy(folder, file, old, new):
    """Copy the modules to `folder` with one text of one file replaced. Raises ValueError unless it occurs once."""
    source = (EXAMPLES / file).read_text("utf-8")
    if source.count(old) != 1:
        raise ValueError(f"{file} has {old!r} {source.count(old)} times; expected once")
    shutil.copytree(EXAMPLES, folder)
    (folder / file).write_text(source.replace(old, new), "utf-8")
    return folder
