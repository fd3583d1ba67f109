"""Commands that show what a robot sees: watch, capture. Shell."""

import json
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Annotated

import typer

from sightline.operator_side.cli.options import DEFAULT_CONNECT, Connect, Json, Port, Robot, Secure
from sightline.operator_side.client.messages import ChannelInbox, message_line, message_object
from sightline.operator_side.client.missions import MissionClient, mission_lines
from sightline.operator_side.client.pictures import Pictures, viewer_role
from sightline.operator_side.client.status import status_lines
from sightline.operator_side.config.errors import no_such_name
from sightline.operator_side.preflight import needs
from sightline.operator_side.terminal import LiveBlock
from sightline.protocol.channels import CHANNELS, FRAME, OVERLAY, PREVIEW, Channel, Direction
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import open_link

_SHOWN = (OVERLAY.name, PREVIEW.name, FRAME.name)
_TEXT_PERIOD_S = 0.25
_WAIT_S = 0.2
_SILENCE_S = 3.0
_EVER = float("inf")

Seconds = Annotated[float | None, typer.Option("--seconds", min=0.1, help="End by itself after this long.")]


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline watch r1   or   sightline watch r1 scan --json")(watch)
    app.command(epilog="Example: sightline capture r1 --overlay --seconds 10 --out run.mp4")(capture)


def watch(
    robot: Robot = "r1",
    channel: Annotated[str | None, typer.Argument(metavar="[CHANNEL]", help="Print what is said on it.")] = None,
    *,
    text: Annotated[bool, typer.Option("--text", help="The robot's state in this terminal, no picture.")] = False,
    show: Annotated[
        str, typer.Option("--show", metavar="CHANNEL", help="On the page: overlay, preview (small) or frame.")
    ] = OVERLAY.name,
    count: Annotated[int | None, typer.Option("--count", min=1, help="Of a channel: end after as many.")] = None,
    seconds: Seconds = None,
    port: Port = 0,
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    as_json: Json = False,
) -> int:
    """Look through a robot's eyes: a page for a browser on this machine with what vision sees, until Ctrl-C.

    With CHANNEL whatever is said on it, one line each. Watching commands nothing.
    """
    if channel is None and (as_json or count):
        raise ConfigError("--json and --count are for one channel: name it, e.g. sightline watch r1 status --json")
    if channel is not None and channel not in CHANNELS:
        raise ConfigError(no_such_name("channel", channel, CHANNELS))
    if show not in _SHOWN:
        raise ConfigError(no_such_name("channel of pictures", show, _SHOWN))
    role, ends_s = viewer_role(secure), time.monotonic() + seconds if seconds else _EVER
    with open_link(robot, connect=connect, role=role, secure=secure) as link, suppress(KeyboardInterrupt):
        if channel is not None:
            shown = (lambda message: json.dumps(message_object(message))) if as_json else message_line
            inbox = ChannelInbox(link, role, CHANNELS[channel], secure)
            return _print_channel(inbox, shown, count or sys.maxsize, ends_s)
        if text:
            return _show_text(link, ends_s)
        with _page(link, role, CHANNELS[show], port, secure) as address:
            typer.echo(f"watch: {robot} is on {address} for a browser on this machine; Ctrl-C ends it")
            while time.monotonic() < ends_s:
                time.sleep(min(_WAIT_S, max(0.0, ends_s - time.monotonic())))
    return 0


def _page(link: Link, role: str, first: Channel, port: int, secure: str) -> AbstractContextManager[str]:
    from sightline.operator_side.cockpit.watch_page import watch_page

    return watch_page(link, role, first, port, secure)


def _print_channel(inbox: ChannelInbox, shown: Callable[[Message], str], count: int, ends_s: float) -> int:
    """Every message as it comes. Raises LinkError if the time is over and none came."""
    silent_s, printed, about = time.monotonic() + _SILENCE_S, 0, f"{inbox.channel.name} of robot {inbox.robot!r}"
    while printed < count and time.monotonic() < ends_s:
        message = inbox.take(_WAIT_S)
        if message is not None:
            typer.echo(shown(message))
            printed += 1
        elif not printed and time.monotonic() > silent_s:
            silent_s = _EVER
            typer.echo(f"watch: nothing is said on {about} so far; {_why_silent(inbox.channel)}", err=True)
    if inbox.dropped:
        typer.echo(f"watch: {inbox.dropped} messages came faster than they could be printed", err=True)
    if not printed and ends_s != _EVER:
        raise LinkError(f"nothing was said on {about}; {_why_silent(inbox.channel)}")
    return 0


def _why_silent(channel: Channel) -> str:
    if channel.said_by == ("vision",):
        return "does `sightline vision` run for it?"
    if channel.name == "scan":
        return "has it a range sensor?"
    if channel.direction is Direction.TO_ROBOT and not channel.passed_on:
        return "this is for the robot alone: only an unsecured tcp/ endpoint lets others hear it"
    return "is the robot running, and does somebody say this?"


def _show_text(link: Link, ends_s: float) -> int:

    missions = MissionClient(link)
    with LiveBlock() as live:
        while time.monotonic() < ends_s:
            try:
                status = missions.operator.wait_report().status
            except LinkError as error:
                live.show([str(error)])
                continue
            mission = missions.newest(0.0)
            live.show([*status_lines(link.robot, status), *(mission_lines(mission) if mission else ())])
            time.sleep(_TEXT_PERIOD_S)
    return 0


# The command `capture`: a snapshot or a video of what a robot sees. Shell.


_SECONDS = 5.0


def capture(
    robot: Robot = "r1",
    *,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="x.png, x.jpg or x.mp4 [default: ROBOT-DATE-TIME.png].")
    ] = None,
    overlay: Annotated[bool, typer.Option("--overlay", help="With what vision drew over it.")] = False,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.1, max=3600, help="A video of this length [default: 5].")
    ] = None,
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    as_json: Json = False,
) -> None:
    """Save what a robot sees: one picture, or with --seconds or an .mp4 a video. Ctrl-C ends a video early."""
    with needs("vision"):
        from sightline.operator_side.recording.film import PICTURES, check_target, film, snapshot
    kind = "mp4" if seconds is not None else "png"
    path = (out or Path(f"{robot}-{time.strftime('%Y%m%d-%H%M%S')}.{kind}")).expanduser()
    check_target(path, seconds)
    wanted, role = OVERLAY if overlay else FRAME, viewer_role(secure)
    with open_link(robot, connect=connect, role=role, secure=secure) as link:
        pictures = Pictures(link, role, wanted, secure)
        if path.suffix.lower() in PICTURES:
            got = snapshot(pictures, path, wanted)
        else:
            got = film(pictures, path, wanted, _SECONDS if seconds is None else seconds)
    if as_json:
        typer.echo(json.dumps({"robot": robot, "file": str(path), "channel": wanted.name, "frames": got.frames,
                               "seconds": round(got.seconds, 3), "width_px": got.width_px, "height_px": got.height_px}))
        return
    length = f", {got.frames} pictures in {got.seconds:.1f} s" if path.suffix.lower() == ".mp4" else ""
    typer.echo(f"{path}: {wanted.name} of {robot}, {got.width_px}x{got.height_px}{length}")
