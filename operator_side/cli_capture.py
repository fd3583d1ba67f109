"""The command `capture`: a snapshot or a video of what a robot sees. Shell."""

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from sightline.operator_side.cli.options import DEFAULT_CONNECT, Connect, Json, Robot, Secure
from sightline.operator_side.preflight import needs
from sightline.operator_side.pictures import Pictures, viewer_role
from sightline.protocol.channels import FRAME, OVERLAY
from sightline.protocol.transports.open import open_link

_SECONDS = 5.0


def register_capture(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline capture r1 --overlay --seconds 10 --out run.mp4")(capture)


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
        from sightline.operator_side.capture import PICTURES, check_target, film, snapshot
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
