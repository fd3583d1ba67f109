"""Sends a robot's WebSocket endpoint random and mutated messages, handshakes among them, as fast as it can.

    python hostile_peer.py PORT COUNT SEED v1|older

What was agreed on is mutated: bits, bytes, lengths, pieces left out, doubled or put in. Prints how many were sent.
"""

import random
import socket
import sys
from contextlib import suppress

BLOCK = (
    b'{"channel":"twist","v":1,"source":"vision","session":"4e5f6071","seq":7,'
    b'"echo":{"channel":"frame","session":"0a1b2c3d","seq":41,"t_us":1500000},"compute_us":2300}'
)
HELLO = b'{"v":1,"robot":"r1","role":"vision","session":"4e5f6071","wants":["frame","status"]}'
REQUEST = b'{"channel":"request","source":"teleop","session":"4e5f6071","seq":1}'
TEXTS = {
    "v1": (HELLO, HELLO.replace(b"r1", b"r2"), b"[" * 1000, b'{"v":' + b"9" * 900 + b"}", b""),
    "older": (b"0.2|-0.3", b"2.3028209556706964|0", b"0.1,0.2,0.3,0.4-0,0,1,1", b"", b"-", b"nan|inf", b"9" * 255),
}
BINARIES = (
    len(BLOCK).to_bytes(2) + BLOCK + b"0.2000|-0.3500",
    len(REQUEST).to_bytes(2) + REQUEST + b'{"id":1,"verb":"arm"}',
    b"\0\0", b"\xff\xff", bytes(1000),
)  # fmt: skip
TRICKS = (b"\0", b"\xff", b"-1", b"1e999", b"NaN", b'"', b"{", b"\xc3\x28")
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n%b\r\n"
)


def framed(dice, opcode, data):
    mask = dice.randbytes(4)
    size = len(data)
    long = bytes([0x80 | size]) if size < 126 else b"\xfe" + size.to_bytes(2)
    return bytes([0x80 | opcode]) + long + mask + bytes(byte ^ mask[at % 4] for at, byte in enumerate(data))


def mutated(dice, data):
    """`data` with one to four things done to it."""
    out = bytearray(data or b"\0")
    for _ in range(dice.randint(1, 4)):
        at, size = dice.randrange(len(out) + 1), dice.randint(1, 16)
        match dice.randrange(6):
            case 0:
                out[min(at, len(out) - 1)] ^= 1 << dice.randrange(8)
            case 1:
                out[at : at + size] = b""
            case 2:
                out[at:at] = dice.randbytes(size)
            case 3:
                out[at:at] = out[at : at + size]
            case 4:
                out[at:] = b""
            case 5:
                out[at : at + size] = dice.choice(TRICKS) * size
        out = out or bytearray(b"\0")
    return bytes(out)


def message(dice, dialect):
    """One message on an open connection: the payload mutated, the frame around it, or neither of any sense."""
    is_text = dialect == "older" or dice.random() < 0.3
    data = dice.choice(TEXTS[dialect] if is_text else BINARIES)
    match dice.randrange(4):
        case 0 | 1:
            return framed(dice, 1 if is_text else 2, mutated(dice, data))
        case 2:
            return mutated(dice, framed(dice, dice.choice([0, 1, 2, 8, 9, 10]), data))
    return dice.randbytes(dice.randint(1, 300))


def main(port, count, seed, dialect):
    dice, sent = random.Random(seed), 0
    offer = UPGRADE % (b"Sec-WebSocket-Protocol: sightline.v1\r\n" if dialect == "v1" else b"")
    while sent < count:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 5) as near:
            near.settimeout(0.002)
            near.sendall(mutated(dice, offer) if dice.random() < 0.1 else offer)
            sent += 1
            if dialect == "v1" and dice.random() < 0.9:
                near.sendall(framed(dice, 1, HELLO))
            while sent < count:
                near.sendall(message(dice, dialect))
                sent += 1
                with suppress(TimeoutError):
                    if not near.recv(65_536):
                        break
    print(sent, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
