"""A robot behind a WebSocket server of a few lines, whose every rule can be broken by name. Shell (sockets).

    with SmallServer(defects={"compresses"}) as server:
        ...  # server.endpoint, server.older

It is written from the specification and shares no code with the library's own WebSocket links: what the kit demands
is met by two servers, or by neither.
"""

import base64
import hashlib
import hmac
import json
import selectors
import socket
import sys
import threading
import time

from sightline.conformance.raw_peers import xor
from sightline.protocol.channels import CHANNELS, Direction, key_for
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.transports.memory import MemoryNetwork
from tests.conformance.robot.reference import ReferenceRobot
from tests.fixtures.ports import free_port

ENTRY = "sightline.token."
GUID = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
HELLO_S = HANDSHAKE_S = 2.0
MOST_BYTES = 2 + 576 + 256
MOST_CLIENTS = 16
STOP_SECRET = b"0123456789abcdef0123456789abcdef"


class EndError(Exception):
    """This connection ends with a close code and a reason."""

    def __init__(self, code, reason):
        super().__init__(reason)
        self.code = code


class SmallServer:
    """Use it in a `with`: one thread, one robot, `sightline.v1` on `endpoint` and the legacy protocol on `older`."""

    def __init__(self, defects=(), tokens=None, port=None):
        """Create the server; `tokens` are role -> token, and without tokens any client may connect."""
        self._port = port
        self.defects, self.tokens = set(defects), tokens or {}
        self.driver, self.driven_s = None, 0.0
        self.asker = None
        self.network = MemoryNetwork()
        self.network.advance(time.monotonic_ns() // 1000)
        self.robot = ReferenceRobot(self.network)
        self._selector = selectors.DefaultSelector()
        self.endpoint = f"ws://127.0.0.1:{self._listen_beside_stop()}"
        self.older = f"ws-legacy://127.0.0.1:{self._listen(True)}"
        self.clients = []
        self._running = True
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _listen(self, older):
        door = socket.create_server(("127.0.0.1", free_port() if older or self._port is None else self._port))
        door.setblocking(False)
        self._selector.register(door, selectors.EVENT_READ, lambda: self._accept(door, older))
        return door.getsockname()[1]

    def _listen_beside_stop(self):
        """Open the link and, at the next higher port, UDP for STOP. Another process may have that one."""
        while True:
            port = self._listen(False)
            if self.has("has no STOP port"):
                return port
            try:
                self.stops = StopPort(self, port + 1)
            except OSError:
                if self._port is not None:
                    return port
                continue
            self._selector.register(self.stops.socket, selectors.EVENT_READ, self.stops.read)
            return port

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._running = False
        self._thread.join(5)
        for client in list(self.clients):
            client.drop()
        for key in list(self._selector.get_map().values()):
            key.fileobj.close()
        self._selector.close()

    def _run(self):
        while self._running:
            for key, _ in self._selector.select(0.004):
                key.data()
            now_us = time.monotonic_ns() // 1000
            self.network.advance(now_us)
            self.robot.tick(now_us)
            self.network.advance(now_us)
            for client in list(self.clients):
                client.tick(time.monotonic())

    def _accept(self, door, older):
        connection, _address = door.accept()
        connection.setblocking(False)
        client = (OlderClient if older else Client)(self, connection)
        self.clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client.read)

    def forget(self, client):
        if client in self.clients:
            self.clients.remove(client)
            self._selector.unregister(client.connection)

    def has(self, defect):
        return defect in self.defects


class StopPort:
    """The STOP port (20), behind a STOP secret where tokens are required."""

    def __init__(self, server, port):
        self.server, self.has, self.number = server, server.has, 0
        self.secret = STOP_SECRET if server.tokens else b""
        self.challenge = b"of this start 16" if self.secret else bytes(16)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", port))

    def read(self):
        data, address = self.socket.recvfrom(2048)
        if answer := self.answer(data):
            self.socket.sendto(answer, address)

    def hmac(self, head):
        return hmac.digest(self.secret, head, "sha256") if self.secret else bytes(32)

    def answer(self, data):
        """The answer to a datagram, or nothing."""
        good = len(data) == 112 and data[:6] == b"STOP\1\1" and data[8:40] == b"r1".ljust(32, b"\0")
        if not good and not self.has("each datagram is a STOP"):
            return b""
        if self.secret and data[48:64] == bytes(16):
            return self.packed(data, 0, 4, 0)
        signed = data[48:64] == self.challenge and data[80:] == self.hmac(data[:80])
        if self.secret and not signed and not self.has("needs no HMAC"):
            return b""
        self.number += 1
        state = 5
        if not self.has("answers STOP and drives on"):
            self.server.robot.driving.gate.stop("STOP by a datagram")
        if self.has("answers STOP without the state"):
            state = 0
        return self.packed(data, state, 1 + 4 * bool(self.secret), self.number)

    def packed(self, data, state, flags, number):
        head = b"STOP\1\2" + bytes((state, flags)) + data[8:48].ljust(40, b"\0") + self.challenge
        head += number.to_bytes(8) * 2
        return head + self.hmac(head)


class Client:
    """One connection of `sightline.v1`."""

    older = False

    def __init__(self, server, connection):
        self.server, self.connection = server, connection
        self.has = server.has
        self.data, self.whole, self.kind = b"", b"", None
        self.opened = self.greeted = self.closing = False
        self.began_s = self.pinged_s = time.monotonic()
        self.unanswered_s = None
        self.role, self.wants, self.heard = "", set(), set()
        self.link = None

    # --- time and ends -------------------------------------------------------------------------------------------

    def tick(self, now_s):
        if not self.opened or self.closing:
            patient = self.opened or self.has("waits for ever for a handshake")
            if now_s - self.began_s > (30 if patient else HANDSHAKE_S) or (self.closing and now_s - self.pinged_s > 1):
                self.drop()
            return
        if not self.greeted and now_s - self.began_s > HELLO_S and not self.has("waits for ever for a hello"):
            self.close(1008, "no hello within 2 s")
        elif self.unanswered_s and now_s - self.unanswered_s > 1.0 and not self.has("keeps the deaf"):
            self.close(1011, "a ping was not answered")
            self.drop()
        elif now_s - self.pinged_s > (2.5 if self.has("pings seldom") else 1.0):
            self.unanswered_s, self.pinged_s = self.unanswered_s or now_s, now_s
            self.send(PING, b"are you there")

    def close(self, code, reason):
        self.send(CLOSE, code.to_bytes(2) + reason.encode())
        self.closing, self.pinged_s = True, time.monotonic()
        if self.link:
            self.link.close()

    def drop(self):
        self.server.forget(self)
        if self.link:
            self.link.close()
        self.connection.close()

    # --- reading -------------------------------------------------------------------------------------------------

    def read(self):
        try:
            data = self.connection.recv(262_144)
        except OSError:
            data = b""
        if not data:
            if self.has("a lost peer stalls all") and self.whole:
                time.sleep(0.7)
            return self.drop()
        self.data += data
        if not self.has("only a pong counts"):
            self.unanswered_s = None
        try:
            while self.step():
                pass
        except EndError as end:
            self.close(end.code, str(end))

    def step(self):
        if self.closing:
            self.data = b""
            return False
        if not self.opened:
            return self.handshake()
        frame = self.take()
        if frame is None:
            return False
        self.on_frame(*frame)
        return True

    def take(self):
        if len(self.data) < 2:
            return None
        first, second = self.data[:2]
        size, at = second & 0x7F, 2
        if size > 125:
            width = 2 if size == 126 else 8
            if len(self.data) < 2 + width:
                return None
            size, at = int.from_bytes(self.data[2 : 2 + width]), 2 + width
        self.check_frame(first, second, size)
        masked = bool(second & 0x80)
        if len(self.data) < at + 4 * masked + size:
            return None
        mask = self.data[at : at + 4] if masked else b"\0\0\0\0"
        body = self.data[at + 4 * masked : at + 4 * masked + size]
        self.data = self.data[at + 4 * masked + size :]
        return bool(first & 0x80), first & 15, xor(body, mask)

    def check_frame(self, first, second, size):
        if not second & 0x80 and not self.has("takes what is not masked"):
            raise EndError(1002, "a client's frame must be masked")
        opcode = first & 15
        if (first & 0x70 or opcode not in (0, TEXT, BINARY, CLOSE, PING, PONG)) and not self.has("takes any opcode"):
            raise EndError(1002, "a reserved bit or opcode")
        if opcode >= CLOSE and size > 125 and not self.has("long pings"):
            raise EndError(1002, "a control frame over 125 bytes")
        most_bytes = self.most_bytes * (4 if self.has("hellos of any length") and not self.older else 1)
        if size > most_bytes and not self.has("older any size" if self.older else "any size"):
            raise EndError(1009, f"{size} bytes, more than this end can want")

    def odd(self, defect):
        """Return whether the defect shows; some show to viewers only, since the kit's link cannot speak past them."""
        return self.has(defect) and self.role == "viewer"

    most_bytes = max(1024, MOST_BYTES)

    def on_frame(self, fin, opcode, body):
        if opcode == CLOSE:
            self.send(CLOSE, body[:2])
            return self.drop()
        if opcode == PING:
            self.send(PONG, b"" if self.odd("pongs are empty") else body)
        elif opcode == PONG:
            self.unanswered_s = None
        elif opcode in (0, TEXT, BINARY):
            self.kind = opcode or self.kind
            self.whole = self.whole + body if opcode == 0 and not self.has("forgets fragments") else body
            if fin:
                message, self.whole = self.whole, b""
                self.on_message(self.kind, message)
        return None

    # --- handshake -----------------------------------------------------------------------------------------------

    def handshake(self):
        if b"\r\n\r\n" not in self.data:
            return False
        head, _, self.data = self.data.partition(b"\r\n\r\n")
        first, *lines = head.decode("latin-1").split("\r\n")
        pairs = (line.partition(":") for line in lines)
        headers = {name.strip().lower(): value.strip() for name, _, value in pairs}
        status, reason = self.judge(headers, first)
        if status:
            self.write(f"HTTP/1.1 {status} {reason}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".encode())
            self.drop()
            return False
        accept = base64.b64encode(hashlib.sha1((headers["sec-websocket-key"] + GUID).encode()).digest()).decode()
        lines = ["Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Accept: {accept}", *self.agreed(headers)]
        self.write(("HTTP/1.1 101 Switching Protocols\r\n" + "\r\n".join(lines) + "\r\n\r\n").encode())
        self.opened, self.began_s = True, time.monotonic()
        return True

    def judge(self, headers, first):
        host, origin = headers.get("host", ""), headers.get("origin")
        name = host.rpartition(":")[0]
        any_host = self.has("older any host" if self.older else "any host")
        if name.replace(".", "").isalpha() and "." in name and not any_host:
            return 403, "Forbidden"
        if origin is not None and self.is_foreign(origin, host):
            return 403, "Forbidden"
        offered = headers.get("sec-websocket-protocol", "").split(", ")
        if not self.older and "sightline.v1" not in offered and not self.has("needs no sub-protocol"):
            return 400, "Bad Request"
        if self.server.tokens and not self.older:
            self.granted = self.role_of(headers, offered, first)
            shows_none = "authorization" not in headers and len(offered) < 2 and "?" not in first
            if not self.granted and not (shows_none and self.has("needs no token")):
                return 401, "Unauthorized"
        peers = sum(client.older == self.older for client in self.server.clients)
        if peers > MOST_CLIENTS and not self.has("any number of clients"):
            return 503, "Service Unavailable"
        return 0, ""

    granted = ""
    again = False  # whether this peer has sent hello more than once

    def role_of(self, headers, offered, first):
        """The role whose token the client shows; "" for none."""
        entries = [entry[len(ENTRY) :] for entry in offered if entry.startswith(ENTRY)]
        word, _, bearer = headers.get("authorization", "").partition(" ")
        known = word == "Bearer" if self.has("bearers in capitals only") else word.lower() == "bearer"
        shown = entries + [bearer] * known
        if self.has("a token in the URL"):
            shown += [first.partition("token=")[2].partition(" ")[0]] * ("token=" in first)
        if len(shown) != 1 and not self.has("one of two tokens will do"):
            return ""
        for role, token in self.server.tokens.items():
            partly = self.has("the beginning of a token will do")
            if any(one == token or (partly and len(one) > 8 and token.startswith(one)) for one in shown):
                return role
        return ""

    def is_foreign(self, origin, host):
        if self.has("no origin at all") and not self.older:
            return True
        return origin != f"http://{host}" and not self.has("older any origin" if self.older else "any origin")

    def agreed(self, headers):
        first = headers.get("sec-websocket-protocol", "").split(",")[0]
        selected = first if self.has("selects the first") else "sightline.v1"
        lines = [] if self.older else [f"Sec-WebSocket-Protocol: {selected}"]
        if self.has("repeats the token") and ENTRY in headers.get("sec-websocket-protocol", ""):
            lines.append(f"X-Offered: {headers['sec-websocket-protocol']}")
        if "sec-websocket-extensions" in headers and self.has("compresses"):
            lines.append("Sec-WebSocket-Extensions: permessage-deflate")
        return lines

    # --- messages ------------------------------------------------------------------------------------------------

    def on_message(self, kind, message):
        if kind == TEXT:
            self.on_hello(message)
        elif not self.greeted and not self.has("needs no hello"):
            raise EndError(1003, "the first message must be a hello, as text")
        else:
            self.on_block(message)

    def on_hello(self, message):
        try:
            text = message.decode("utf-8", "replace" if self.has("takes broken text") else "strict")
        except UnicodeDecodeError:
            raise EndError(1007, "text that is not UTF-8") from None
        try:
            hello = json.loads(text)
        except ValueError:
            hello = {}
        if len(message) > 1024 and not self.has("hellos of any length"):
            raise EndError(1009, "this hello is too long")
        if not (self.greeted and self.has("any later hello")):
            self.check_hello(hello)
        self.again = self.greeted
        if self.link is None:
            self.link = self.server.network.link("r1", role="viewer")
        if self.greeted and self.odd("first wants count"):
            return
        if not (self.greeted and self.has("first role counts")):
            self.role = hello.get("role", "")
        wants = set(hello.get("wants", ()))
        self.want(wants)
        if not self.greeted:
            name = "r2" if self.odd("sends another name") else "r1"
            answer = {"v": 1, "robot": name, "session": "00000001", "wants": ["twist", "ack", "request"]}
            self.send(TEXT, json.dumps(answer).encode())
        self.greeted = True
        if set(hello.get("wants", ())) - set(CHANNELS) and self.has("knows all wants"):
            raise EndError(1008, "an unknown channel")

    def check_hello(self, hello):
        trusts = (lambda defect: False) if self.greeted else self.has
        if hello.get("session") is None and not trusts("takes any text"):
            raise EndError(1008, "invalid hello")
        if hello.get("v", 1) != 1 and not trusts("any version"):
            raise EndError(1008, "another version")
        if hello.get("robot", "r1") != "r1" and not trusts("any robot"):
            raise EndError(1008, f"this is robot r1, not {hello['robot']}")

    def want(self, wants):
        known = {one.name for one in CHANNELS.values() if one.direction is Direction.FROM_ROBOT}
        known |= set() if self.has("keeps detections") else {"detections"}
        known |= set() if self.has("keeps missions") else {"mission", "report"}
        wants = (wants | {"odometry"} if self.has("sends odometry unasked") else wants) & known
        for name in sorted(wants - self.heard):
            self.link.subscribe(CHANNELS[name], self.publish)
        self.heard |= wants
        self.wants = wants

    def publish(self, message):
        name = message.channel.name
        kept = name == "reply" and self.has("replies to the requester") and self is not self.server.asker
        if name in self.wants and not self.closing and not kept:
            fields = b'{"channel":"%b",' % message.channel.name.encode() + message.header[1:]
            if self.odd("names no channel") and message.channel.name == "odometry":
                fields = message.header
            payload = message.payload
            if self.has("rewrites missions") and message.channel.name in ("mission", "report"):
                payload = json.dumps(json.loads(payload)).encode()
            self.send(BINARY, len(fields).to_bytes(2) + fields + payload)

    def on_block(self, message):
        size = int.from_bytes(message[:2])
        if len(message) < 2 + size and not self.has("takes cut blocks"):
            raise EndError(1007, "the header block is cut")
        if size > 576 and not self.has("long blocks"):
            raise EndError(1007, "the header block is too long")
        block, payload = message[2 : 2 + size], message[2 + size :]
        if self.has("reads the first field") and b'"channel":' in block[2:]:
            return
        name, source, header = self.read_block(block)
        if name is None:
            if self.has("takes nameless blocks"):
                return
            raise EndError(1007, "the header block names no channel")
        channel = CHANNELS.get(name)
        if channel is None or channel.direction is Direction.FROM_ROBOT:
            if self.has("ends on unknown channels"):
                raise EndError(1008, "an unknown channel")
            return
        if self.server.tokens and not self.may_say(name, source):
            return
        if not header and self.has("twists need a header"):
            return
        try:
            key = key_for("r1", channel, source)
        except ValueError:
            return
        if name == "request":
            self.server.asker = self
        if len(header) <= 512 and len(payload) <= channel.max_payload_bytes:
            self.server.network.put(key, header, payload, self.link)

    def may_say(self, name, source):
        """Return whether the token's role may publish this message."""
        if self.has("any token for every role"):
            return True
        own = ("operator", "teleop") if self.granted == "operator" else (self.granted,)
        return source in own and (name != "request" or self.granted == "operator")

    def read_block(self, block):
        """(channel, source, header)."""
        try:
            fields = json.loads(block)
        except ValueError:
            name = block.partition(b'{"channel":"')[2].partition(b'"')[0].decode("utf-8", "replace")
            if self.has("drops invalid JSON"):
                return "nothing of ours", self.role, b""
            return name or None, self.role, b"{" + block.partition(b",")[2]
        name = fields.pop("channel", None) if isinstance(fields, dict) else None
        fallback = "viewer" if self.has("forgets the role") and not self.again else self.role
        header = b"" if set(fields) <= {"source"} else json.dumps(fields, separators=(",", ":")).encode()
        return name, fields.get("source", fallback), header

    def send(self, opcode, body):
        size = len(body)
        head = bytes([0x80 | opcode, size]) if size < 126 else bytes([0x80 | opcode, 126]) + size.to_bytes(2)
        self.write(head + body)

    def write(self, data):
        try:
            self.connection.sendall(data)
        except OSError:  # full or gone: a server this small sends nothing twice
            return


class OlderClient(Client):
    """One connection of the legacy protocol: base64 out, `linear|angular` in."""

    older = True
    most_bytes = 256

    def handshake(self):
        if not super().handshake():
            return False
        self.greeted = True
        self.link = self.server.network.link("r1", role="guest")
        self.link.subscribe(CHANNELS["frame"], self.picture)
        return True

    def tick(self, now_s):
        super().tick(now_s)
        if self.has("impatient") and self.opened and now_s - self.began_s > 1.8 and not self.commands:
            self.drop()

    commands = 0
    shown = None

    def drives(self, message):
        """Return whether this client drives; count its valid twist as NOT_HOLDER while another client drives."""
        server, now_s = self.server, time.monotonic()
        other = server.driver not in (None, self) and now_s - server.driven_s < 1.0 and server.driver in server.clients
        if message.count(b"|") != 1:
            return True
        if other and not self.has("any client drives"):
            server.robot.driving.gate.reject("guest", WireError(RejectReason.NOT_HOLDER, "another client drives"))
            return False
        server.driver, server.driven_s = self, now_s
        return True

    def picture(self, message):
        if self.has("one client at a time") and next(one for one in self.server.clients if one.older) is not self:
            return
        self.shown = json.loads(message.header)
        text = base64.encodebytes(message.payload)
        text = text.replace(b"\n", b"") if self.has("one line") else text
        if self.has("pictures are binary"):
            self.send(BINARY, message.payload)
        else:
            self.send(TEXT, text)

    def on_message(self, kind, message):
        if kind == BINARY and not self.has("older binary"):
            raise EndError(1003, "this port speaks text")
        if self.has("ends on bad twists") and message.count(b"|") != 1:
            raise EndError(1008, "no twist")
        self.commands += 1
        if not self.drives(message):
            return
        if not self.has("deaf to twists"):
            self.server.network.put("sightline/r1/twist/guest", b"", message[:64], self.link)
        if self.shown is not None and not self.has("returns no credit"):
            echo = {"channel": "frame", **{name: self.shown[name] for name in ("session", "seq", "t_us")}}
            header = {"source": "guest", "session": "00000000", "seq": self.commands, "echo": echo}
            self.server.network.put("sightline/r1/ack/guest", json.dumps(header).encode(), b"", self.link)
            self.shown = None


if __name__ == "__main__":  # for `conform --jobs --start`: its argument is the endpoint
    with SmallServer(port=int(sys.argv[1].rpartition(":")[2])):
        threading.Event().wait()
