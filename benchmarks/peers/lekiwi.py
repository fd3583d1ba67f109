"""ZeroMQ as LeKiwi uses it: PUSH and PULL that keep the newest message; commands are read once a tick. Shell.

Images go as base64 in JSON, with the robot's state, as there. The command that a tick reads answers an earlier tick.
"""

from __future__ import annotations

import base64
import json
import time
from typing import TYPE_CHECKING

import zmq

if TYPE_CHECKING:
    from sightline.benchmarks.peers.contest import RecordedFrames, Tally, Vision

Socket = zmq.Socket[bytes]


def _newest(context: zmq.Context[Socket], kind: int) -> Socket:
    made = context.socket(kind)
    made.setsockopt(zmq.CONFLATE, 1)
    return made


def robot(film: RecordedFrames, tally: Tally, port: int) -> None:
    """Tick at the images' pace: command in, image out."""
    context = zmq.Context()
    commands, observations = _newest(context, zmq.PULL), _newest(context, zmq.PUSH)
    commands.bind(f"tcp://127.0.0.1:{port}")
    observations.bind(f"tcp://127.0.0.1:{port + 1}")
    while True:
        time.sleep(film.next_in_s())
        _read_command(commands, tally)
        t_us, jpeg = film.shoot()
        tally.capture(t_us)
        observation = {"t_us": t_us, "x.vel": 0.0, "theta.vel": 0.0, "front": base64.b64encode(jpeg).decode()}
        try:
            observations.send_string(json.dumps(observation), flags=zmq.NOBLOCK)
        except zmq.Again:
            continue  # no reader


def _read_command(commands: Socket, tally: Tally) -> None:
    try:
        command = json.loads(commands.recv_string(zmq.NOBLOCK))
    except zmq.Again:
        return
    float(command["x.vel"]), float(command["theta.vel"])
    tally.judge(command["t_us"])


def vision(eyes: Vision, port: int) -> None:
    """Answer the newest image of the robot at `port`."""
    context = zmq.Context()
    commands, observations = _newest(context, zmq.PUSH), _newest(context, zmq.PULL)
    commands.connect(f"tcp://127.0.0.1:{port}")
    observations.connect(f"tcp://127.0.0.1:{port + 1}")
    while True:
        observation = json.loads(observations.recv_string())
        linear, angular = eyes.answer(observation["t_us"], base64.b64decode(observation["front"])).split("|")
        command = {"t_us": observation["t_us"], "x.vel": float(linear), "theta.vel": float(angular)}
        commands.send_string(json.dumps(command))
