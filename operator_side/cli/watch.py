"""Commands that show or save a robot's images and messages: watch, capture. Shell."""

import csv
import io
import json
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.operator_side.cli.operate import follow_status
from sightline.operator_side.cli.options import Connect, Json, Port, Robot, Secure, first_given
from sightline.operator_side.client.messages import (
    TARGET_COLUMNS,
    ChannelInbox,
    message_line,
    message_object,
    target_line,
    target_object,
)
from sightline.operator_side.client.missions import MissionClient
from sightline.operator_side.client.pictures import Pictures, viewer_role
from sightline.operator_side.config.context import target_of
from sightline.operator_side.config.errors import no_such_name
from sightline.operator_side.preflight import needs
from sightline.protocol.channels import CHANNELS, FRAME, OVERLAY, PREVIEW, REPORT, Channel, Direction
from sightline.protocol.errors import ConfigError, LinkError, home_path
from sightline.protocol.log import printable
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import open_link

if TYPE_CHECKING:
    from sightline.operator_side.recording.film import Cut
    from sightline.operator_side.recording.recorder import Recorder

_TARGET = "target"
_SHOWN = (OVERLAY.name, PREVIEW.name, FRAME.name)
_WAIT_S = 0.2
_SILENCE_S = 3.0
_EVER = float("inf")

Seconds = Annotated[float | None, typer.Option("--seconds", min=0.1, help="End after this many seconds.")]


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline watch r1   or   sightline watch r1 scan --json")(watch)
    app.command(epilog="Example: sightline capture r1 --overlay --seconds 10 --out run.mp4")(capture)


def watch(
    robot: Robot = None,
    channel: Annotated[
        str | None, typer.Argument(metavar="CHANNEL", help="Print its messages; target: what is followed.")
    ] = None,
    *,
    text: Annotated[bool, typer.Option("--text", help="Show the robot's state in this terminal.")] = False,
    show: Annotated[
        str, typer.Option("--show", metavar="CHANNEL", help="Images on the page: overlay, preview (small) or frame.")
    ] = OVERLAY.name,
    count: Annotated[int | None, typer.Option("--count", min=1, help="Stop after this many messages.")] = None,
    seconds: Seconds = None,
    port: Port = 0,
    connect: Connect = None,
    secure: Secure = "",
    as_json: Json = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print the target as a table for other programs.")] = False,
) -> int:
    """Show a robot's images or messages live

    It serves a page for a browser on this machine until Ctrl-C. With CHANNEL, it prints the messages, one per line;
    with target, bearing and distance of what the vision service follows.
    """
    if channel is None and (as_json or count):
        raise ConfigError("--json and --count need a channel; name it, e.g. sightline watch r1 status --json")
    of_page = {"--text": text, "--show": show != OVERLAY.name, "--port": port}
    if channel is not None and (unused := first_given(of_page)):
        raise ConfigError(f"{unused} has no effect on channel '{channel}'; remove one of the two")
    if as_csv and (channel != _TARGET or as_json):
        raise ConfigError("--csv is for the target and without --json: sightline watch r1 target --csv")
    if channel is not None and channel not in (*CHANNELS, _TARGET):
        raise ConfigError(no_such_name("channel", channel, [*CHANNELS, _TARGET]))
    if show not in _SHOWN:
        raise ConfigError(no_such_name("channel of images", show, _SHOWN))
    target = target_of(robot, connect, secure)
    robot, secure = target.robot, target.secure
    role, ends_s = viewer_role(secure), time.monotonic() + seconds if seconds else _EVER
    with open_link(robot, connect=target.connect, role=role, secure=secure) as link, suppress(KeyboardInterrupt):
        if channel is not None:
            shown = _target_form(robot, as_json, as_csv) if channel == _TARGET else _message_form(as_json)
            inbox = ChannelInbox(link, role, REPORT if channel == _TARGET else CHANNELS[channel], secure)
            return _print_channel(inbox, shown, count or sys.maxsize, ends_s)
        if text:
            return follow_status(MissionClient(link), verbose=True, ends_s=ends_s)
        with _page(link, role, CHANNELS[show], port, secure) as address:
            typer.echo(f"watch: {robot} is at {address} for a browser on this machine; Ctrl-C ends it")
            while time.monotonic() < ends_s:
                time.sleep(min(_WAIT_S, max(0.0, ends_s - time.monotonic())))
    return 0


def _message_form(as_json: bool) -> Callable[[Message], str]:
    return (lambda message: json.dumps(message_object(message))) if as_json else message_line


def _target_form(robot: str, as_json: bool, as_csv: bool) -> Callable[[Message], str]:
    """Return a function that formats a report as the target's line. For CSV it first prints the column names."""
    if as_csv:
        typer.echo(",".join(TARGET_COLUMNS))

    def form(message: Message) -> str:
        target = target_object(message) | {"robot": robot}
        if as_csv:
            line = io.StringIO()
            csv.writer(line, lineterminator="").writerow("" if one is None else one for one in target.values())
            return printable(line.getvalue())
        return json.dumps(target) if as_json else target_line(target)

    return form


def _page(link: Link, role: str, first: Channel, port: int, secure: str) -> AbstractContextManager[str]:
    from sightline.operator_side.cockpit.watch_page import watch_page

    return watch_page(link, role, first, port, secure)


def _print_channel(inbox: ChannelInbox, shown: Callable[[Message], str], count: int, ends_s: float) -> int:
    """Print each message. Raises LinkError if none arrives in time."""
    silent_s, printed = time.monotonic() + _SILENCE_S, 0
    about = f"channel {inbox.channel.name} of robot '{inbox.robot}'"
    while printed < count and time.monotonic() < ends_s:
        message = inbox.take(_WAIT_S)
        if message is not None:
            typer.echo(shown(message))
            printed += 1
        elif not printed and time.monotonic() > silent_s:
            silent_s = _EVER
            typer.echo(f"watch: no message yet on {about}; {_silence_fix(inbox.channel)}", err=True)
    if inbox.dropped:
        typer.echo(f"watch: dropped {inbox.dropped} messages that came faster than the terminal printed", err=True)
    if not printed and ends_s != _EVER:
        raise LinkError(f"no message on {about}; {_silence_fix(inbox.channel)}")
    return 0


def _silence_fix(channel: Channel) -> str:
    if channel.published_by == ("vision",):
        return "run `sightline vision` for the robot"
    if channel.name == "scan":
        return "check that the robot has a range sensor"
    if channel.direction is Direction.TO_ROBOT and not channel.passed_on:
        return ("check its publisher, and connect by an unsecured tcp/ endpoint, since other links deliver it to the "
                "robot only")
    return "check that the robot and the publisher of this channel run"


# --- `capture` ---------------------------------------------------------------------------------------------------


_SECONDS = 5.0


def capture(
    robot: Robot = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="x.png, .jpg, .mp4 or .mcap [default: ROBOT-DATE-TIME.png]."),
    ] = None,
    overlay: Annotated[bool, typer.Option("--overlay", help="Include the drawing of the vision service.")] = False,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.1, max=3600, help="Length of a video or recording [default: 5].")
    ] = None,
    connect: Connect = None,
    secure: Secure = "",
    as_json: Json = False,
) -> None:
    """Save an image, a video or a recording of a robot

    With --seconds or an .mp4 file it saves a video, with an .mcap file the messages. Ctrl-C ends both early.
    """
    with needs("vision"):
        from sightline.operator_side.recording.film import MESSAGES, PICTURES, check_target, film, record, snapshot
    target = target_of(robot, connect, secure)
    robot, secure = target.robot, target.secure
    kind = "mp4" if seconds is not None else "png"
    path = home_path(out or Path(f"{robot}-{datetime.now():%Y%m%d-%H%M%S-%f}.{kind}"))
    check_target(path, seconds)
    wanted, role = OVERLAY if overlay else FRAME, viewer_role(secure)
    with open_link(robot, connect=target.connect, role=role, secure=secure) as link:
        length_s = _SECONDS if seconds is None else seconds
        if path.suffix.lower() == MESSAGES:
            recorder, cut = record(link, Pictures(link, role, FRAME, secure), path, wanted, length_s)
            _print_recording(robot, path, recorder, cut, as_json)
            return
        pictures = Pictures(link, role, wanted, secure)
        if path.suffix.lower() in PICTURES:
            got = snapshot(pictures, path, wanted)
        else:
            got = film(pictures, path, wanted, length_s)
    if got.cut == "silent":
        _warn_silent("images", got.seconds, "video", robot)
    if as_json:
        typer.echo(json.dumps({"robot": robot, "file": str(path), "channel": wanted.name, "frames": got.frames,
                               "seconds": round(got.seconds, 3), "width_px": got.width_px, "height_px": got.height_px,
                               "complete": not got.cut}))
        return
    length = f", {got.frames} images in {got.seconds:.1f} s" if path.suffix.lower() == ".mp4" else ""
    typer.echo(f"{path}: {wanted.name} of {robot}, {got.width_px}x{got.height_px}{length}")


def _warn_silent(what: str, seconds: float, file: str, robot: str) -> None:
    typer.echo(f"capture: no more {what} after {seconds:.1f} s, so the {file} is shorter than requested; run "
               f"`sightline status {robot}`", err=True)


def _print_recording(robot: str, path: Path, recorder: "Recorder", cut: "Cut", as_json: bool) -> None:
    counts = recorder.counts
    if cut == "silent":
        _warn_silent("messages", recorder.seconds, "recording", robot)
    if recorder.dropped:
        typer.echo(f"capture: {recorder.dropped} messages are missing, because {path} is on a slow disk", err=True)
    if as_json:
        typer.echo(json.dumps({"robot": robot, "file": str(path), "messages": counts, "dropped": recorder.dropped,
                               "seconds": round(recorder.seconds, 3), "complete": not (recorder.dropped or cut)}))
        return
    listed = ", ".join(f"{topic} {count}" for topic, count in sorted(counts.items()))
    typer.echo(f"{path}: {sum(counts.values())} messages of {robot}: {listed}")
