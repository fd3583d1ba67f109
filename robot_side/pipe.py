"""What the driver process and its network child say to each other, one SOCK_SEQPACKET packet each. Pure.

    network -> driver   RAW     bytes of a twist or request as they came: channel, source, header, payload
                        STREAM  stream counters, JSON
                        REFUSED what the transport turned away so far: how often, by reason
                        READY   the endpoint is open
              aside     ISSUED  a frame is about to be published: seq, capture time, fingerprint
    driver -> network   VERDICT a twist was judged: whose, which frame, computing time, and who drives
                        PUBLISH bytes to publish: channel, header, payload
              aside     MOTION  what the next frame's header says of the robot

`aside` is a second socket that nobody waits on: whoever needs what is there reads it all first. So a frame that leaves
wakes no driver just when vision wants the processor, and no tick wakes the network process. The driver reads ISSUED
before it judges a RAW: it was sent before the frame, so it is there before any answer.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

from sightline.protocol.channels import CHANNELS
from sightline.protocol.messages import Holder, Planar, Pose
from sightline.protocol.transports.link import Message

MAX_PACKET_BYTES = 65_536
_ISSUED = struct.Struct("<BQQI")
_MOTION = struct.Struct("<B7dq")
_ACK = struct.Struct("<BQQ16s8s16s8s")
_PARTS = struct.Struct("<B16s16sH")


class PacketKind(IntEnum):
    """First byte of a packet."""

    ISSUED = 1
    RAW = 2
    STREAM = 3
    READY = 4
    MOTION = 5
    VERDICT = 6
    PUBLISH = 7
    REFUSED = 8


@dataclass(frozen=True, slots=True)
class Motion:
    """The robot at this moment, for frame headers."""

    pose: Pose = (0.0, 0.0, 0.0)
    moving: Planar = (0.0, 0.0)
    applied: Planar = (0.0, 0.0)
    latency_us: int | None = None


@dataclass(frozen=True, slots=True)
class CommandAck:
    """A twist was judged (accepted or refused): it answers frame `seq`; `holder` drives now."""

    sender: Holder
    seq: int
    compute_us: int
    holder: Holder | None


def packet_kind(packet: bytes) -> PacketKind:
    """The kind of a packet of ours."""
    return PacketKind(packet[0])


def pack_issued(seq: int, t_us: int, fingerprint: int) -> bytes:
    """A frame is about to be published."""
    return _ISSUED.pack(PacketKind.ISSUED, seq, t_us, fingerprint)


def unpack_issued(packet: bytes) -> tuple[int, int, int]:
    """(seq, t_us, fingerprint)."""
    _, seq, t_us, fingerprint = _ISSUED.unpack(packet)
    return seq, t_us, fingerprint


def pack_motion(motion: Motion) -> bytes:
    """The robot at this moment."""
    latency_us = -1 if motion.latency_us is None else motion.latency_us
    return _MOTION.pack(PacketKind.MOTION, *motion.pose, *motion.moving, *motion.applied, latency_us)


def unpack_motion(packet: bytes) -> Motion:
    """The inverse."""
    _, x, y, yaw, linear, angular, applied_linear, applied_angular, latency_us = _MOTION.unpack(packet)
    latency = None if latency_us < 0 else latency_us
    return Motion((x, y, yaw), (linear, angular), (applied_linear, applied_angular), latency)


def pack_ack(judged: CommandAck) -> bytes:
    """A twist was judged."""
    return _ACK.pack(
        PacketKind.VERDICT, judged.seq, judged.compute_us, *_pack_holder(judged.sender), *_pack_holder(judged.holder)
    )


def unpack_ack(packet: bytes) -> CommandAck:
    """The inverse."""
    _, seq, compute_us, source, session, holder_source, holder_session = _ACK.unpack(packet)
    sender = _unpack_holder(source, session)
    if sender is None:
        raise ValueError("a judged twist has a sender")
    return CommandAck(sender, seq, compute_us, _unpack_holder(holder_source, holder_session))


def _pack_holder(holder: Holder | None) -> tuple[bytes, bytes]:
    return (holder.source.encode(), holder.session.encode()) if holder else (b"", b"")


def _unpack_holder(source: bytes, session: bytes) -> Holder | None:
    name = source.rstrip(b"\0").decode()
    return Holder(source=name, session=session.decode()) if name else None


def pack_rejected(counts: Mapping[str, int]) -> bytes:
    """What never reached the driver, by reason."""
    return bytes([PacketKind.REFUSED]) + json.dumps(dict(counts)).encode()


def unpack_rejected(packet: bytes) -> dict[str, int]:
    """The inverse."""
    counts = json.loads(packet[1:])
    return {str(reason): int(count) for reason, count in counts.items()}


def pack_message(kind: PacketKind, message: Message) -> bytes:
    """RAW or PUBLISH: a message of the wire, undecoded."""
    head = _PARTS.pack(kind, message.channel.name.encode(), message.source.encode(), len(message.header))
    return head + message.header + message.payload


def unpack_message(packet: bytes) -> Message:
    """The inverse."""
    _, name, source, header_bytes = _PARTS.unpack_from(packet)
    start = _PARTS.size
    channel = CHANNELS[name.rstrip(b"\0").decode()]
    body = start + header_bytes
    return Message(channel, source.rstrip(b"\0").decode(), packet[start:body], packet[body:])
