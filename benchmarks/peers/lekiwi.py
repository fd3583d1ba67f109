"""ZeroMQ as LeKiwi uses it: PUSH and PULL with short queues; commands are read once a tick. Shell.

An image is the second part of a message, raw JPEG after a JSON header, and the receiver drains its queue to the
newest one: `src/lerobot/robots/lekiwi` of github.com/huggingface/lerobot at 7427f318. The command that a tick reads
answers an earlier tick.
"""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Final

import zmq

if TYPE_CHECKING:
    from sightline.benchmarks.peers.contest import RecordedFrames, Tally, Vision

Socket = zmq.Socket[bytes]
QUEUE: Final = 2
"""Images in each queue: ZeroMQ cannot keep only the newest one of messages with several parts."""


def _socket(context: zmq.Context[Socket], kind: int, option: int, value: int) -> Socket:
    made = context.socket(kind)
    made.setsockopt(option, value)
    return made


def robot(film: RecordedFrames, tally: Tally, port: int) -> None:
    """Tick at the pace of the images: read a command, send an image."""
    context = zmq.Context()
    commands = _socket(context, zmq.PULL, zmq.CONFLATE, 1)
    observations = _socket(context, zmq.PUSH, zmq.SNDHWM, QUEUE)
    commands.bind(f"tcp://127.0.0.1:{port}")
    observations.bind(f"tcp://127.0.0.1:{port + 1}")
    while True:
        time.sleep(film.next_in_s())
        _read_command(commands, tally)
        t_us, jpeg = film.shoot()
        tally.capture(t_us)
        header = {"_cams": ["front"], "t_us": t_us, "x.vel": 0.0, "theta.vel": 0.0}
        try:
            observations.send_multipart([json.dumps(header).encode(), jpeg], flags=zmq.NOBLOCK)
        except zmq.Again:
            continue  # no reader


def _read_command(commands: Socket, tally: Tally) -> None:
    try:
        command = json.loads(commands.recv_string(zmq.NOBLOCK))
    except zmq.Again:
        return
    float(command["x.vel"]), float(command["theta.vel"])
    tally.validate(command["t_us"])


def vision(detector: Vision, port: int) -> None:
    """Answer the newest image of the robot at `port`."""
    context = zmq.Context()
    commands = _socket(context, zmq.PUSH, zmq.CONFLATE, 1)
    observations = _socket(context, zmq.PULL, zmq.RCVHWM, QUEUE)
    commands.connect(f"tcp://127.0.0.1:{port}")
    observations.connect(f"tcp://127.0.0.1:{port + 1}")
    while True:
        header, jpeg = _newest(observations)
        t_us = json.loads(header)["t_us"]
        linear, angular = detector.answer(t_us, jpeg).split("|")
        commands.send_string(json.dumps({"t_us": t_us, "x.vel": float(linear), "theta.vel": float(angular)}))


def _newest(observations: Socket) -> list[bytes]:
    newest = observations.recv_multipart()
    while True:
        try:
            newest = observations.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return newest
