"""The command stop. Shell.

It imports only what a STOP datagram needs: the libraries of the link take most of the time until it leaves.
"""

import json
from collections.abc import Sequence
from typing import Any

import typer

from sightline.operator_side.cli.app import ABANDONED_THREAD
from sightline.operator_side.cli.options import Connect, Json, Robot, Secure, stop_secret_of, target_of
from sightline.operator_side.client.stop import stop_robot


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline stop r1 --connect tcp/192.168.1.20:7447")(stop)


def plain_options(arguments: Sequence[str]) -> dict[str, Any] | None:
    """Return the options of `stop` if all words are plain: ROBOT, --connect, --secure and --json; else None."""
    given: dict[str, Any] = {"robot": None, "connect": [], "secure": "", "as_json": False}
    words = iter(arguments)
    for word in words:
        name, has_value, value = word.partition("=")
        if word == "--json":
            given["as_json"] = True
        elif name in ("--connect", "--secure"):
            value = value if has_value else next(words, "")
            if not value or value.startswith("-"):
                return None
            given[name[2:]] = [*given["connect"], value] if name == "--connect" else value
        elif not word or word.startswith("-") or given["robot"] is not None:
            return None
        else:
            given["robot"] = word
    return given


def stop(robot: Robot = None, connect: Connect = None, secure: Secure = "", as_json: Json = False) -> None:
    """STOP a robot and latch the stop until reset

    The wheels stay at zero until `sightline reset`. STOP needs the network, so it is not an emergency stop.
    """

    def on_slow() -> None:
        typer.echo(f"STOP of {target.robot} is not confirmed, repeating; be ready to cut its power by hand", err=True)

    target = target_of(robot, connect, secure, announce=True)
    done = stop_robot(
        target.robot, target.connect, target.secure, stop_secret_of(target), on_slow, thread_name=ABANDONED_THREAD
    )
    if not done.stored:
        typer.echo(f"STOP of {target.robot} is not on its disk, so that a restart ends it; is the disk full?", err=True)
    detail = done.status.reason if done.status else "wheels at zero"
    if as_json:
        typer.echo(json.dumps({"robot": target.robot, "ok": True, "state": "STOPPED", "detail": detail}))
    else:
        typer.echo(f"{target.robot}: STOPPED ({detail})")
