"""The commands `conform robot | vision | codec | page`: does any peer speak the protocol, point by point. Shell."""

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from sightline.operator_side.cli.options import CHECK_FAILED
from sightline.operator_side.cli.conform import access_for
from sightline.operator_side.conform_table import listing, print_results, progress
from sightline.operator_side.out_file import check_out_file
from sightline.protocol.conformance.html_report import to_html
from sightline.conformance.benches import LiveBench
from sightline.conformance.report import to_dict, to_junit, to_page
from sightline.conformance.runner import Result, chosen, passed, run_cases
from sightline.protocol.errors import ConfigError, LinkError

_ROLES = ("vision", "operator")
"""Whom the kit plays where each role has keys of its own."""
TRIES = 3
"""A message may be lost on any network, and a machine busy; a case that fails three times in a row failed."""

Only = Annotated[
    list[str] | None, typer.Option("--only", metavar="ID", help="A case, or how several begin: R-CAUS; repeatable.")
]
Groups = Annotated[list[str] | None, typer.Option("--group", metavar="NAME", help="A group such as lease; repeatable.")]
Listing = Annotated[bool, typer.Option("--list", help="Name the cases and what each demands; test nothing.")]
Robot = Annotated[str, typer.Option("--robot", metavar="ID", help="The robot's id.")]
Secure = Annotated[
    str, typer.Option("--secure", metavar="DIR", help="Keys made by `sightline keys`: for tls/, wss:// and tokens.")
]
Tokens = Annotated[
    list[str] | None,
    typer.Option(
        "--token", metavar="[ROLE=]FILE",
        help="File with the WebSocket token of vision or operator, or of both; repeatable.",
    ),
]  # fmt: skip
OwnToken = Annotated[
    list[str] | None, typer.Option("--token", metavar="FILE", help="File with the WebSocket token to ask for.")
]
Junit = Annotated[Path | None, typer.Option("--junit", metavar="FILE", help="Write JUnit XML, for a CI.")]
Html = Annotated[Path | None, typer.Option("--html", metavar="FILE", help="Write one HTML file, for a person.")]
Save = Annotated[Path | None, typer.Option("--save", metavar="FILE", help="Write the JSON, for `conform page`.")]
Name = Annotated[str, typer.Option("--name", metavar="TEXT", help="The peer's name in reports [default: where it is].")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")]


def register_conform(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(
        help="Test any robot, vision or codec against the wire protocol, case by case.",
        no_args_is_help=False, rich_markup_mode=None,
    )  # fmt: skip
    group.command(epilog="Example: sightline conform robot ws://192.168.1.20:9090 --html report.html")(robot)
    group.command(epilog="Example: sightline conform vision tcp/127.0.0.1:7447")(vision)
    group.command(epilog="Example: sightline conform codec -- node codec.js")(codec)
    group.command(epilog="Example: sightline conform page --out docs/conformance.md robot.json vision.json")(page)
    app.add_typer(group, name="conform")


def robot(
    endpoint: Annotated[str, typer.Argument(metavar="ENDPOINT", help="Where it listens: tcp/..., ws:// or wss://.")],
    *,
    robot: Robot = "r1",
    older: Annotated[
        str, typer.Option("--older", metavar="ENDPOINT", help="Its older dialect's port, ws-legacy://HOST:9091.")
    ] = "",
    secure: Secure = "",
    tokens: Tokens = None,
    only: Only = None,
    groups: Groups = None,
    list_cases: Listing = False,
    junit: Junit = None,
    html: Html = None,
    save: Save = None,
    name: Name = "",
    as_json: Json = False,
) -> int:
    """Test a robot as its driver, its watcher and its enemy. It is armed and its wheels turn: lift it off the floor."""
    from sightline.conformance.robot import cases as side
    from sightline.conformance.robot.websocket import put_over_websocket
    from sightline.protocol.conformance.strangers import RawZenoh
    from sightline.protocol.conformance.virtual import FROM_ROBOT
    from sightline.protocol.transports.open import open_link

    cases = chosen(side.CASES, only or (), groups or ())
    if list_cases:
        typer.echo(listing(cases))
        return 0
    _check_files(junit, html, save)
    with ExitStack() as ending:
        access = access_for(secure, tokens or (), _ROLES, ending)

        def open_it(role: str) -> Any:
            return open_link(robot, connect=[endpoint], role=role, secure=access.folder)

        def put_it(key: str, header: bytes, payload: bytes) -> None:
            put_over_websocket(bench, key, header, payload)

        put = put_it if "://" in endpoint else ending.enter_context(RawZenoh(endpoint, access.folder)).put
        roles = _ROLES if access.is_guarded else _ROLES[:1]
        bench = LiveBench(
            robot, open_it, FROM_ROBOT, put, roles=roles, endpoint=endpoint, older=older, access=access
        )  # fmt: skip
        ending.enter_context(bench)
        if not side.is_there(bench):
            raise LinkError(f"{endpoint} answers, but no robot {robot} says its status there; is that its id?")
        tell = ending.enter_context(progress(len(cases)))
        results = run_cases(cases, bench, side.prepare, tell, TRIES)
    return _report(results, "robot", name or endpoint, (junit, html, save), as_json)


def vision(
    endpoint: Annotated[str, typer.Argument(metavar="ENDPOINT", help="Where the kit listens, as a robot would.")],
    *,
    robot: Robot = "r1",
    dial: Annotated[bool, typer.Option("--dial", help="Connect to a vision or router that listens there.")] = False,
    secure: Secure = "",
    tokens: OwnToken = None,
    only: Only = None,
    groups: Groups = None,
    list_cases: Listing = False,
    junit: Junit = None,
    html: Html = None,
    save: Save = None,
    name: Name = "",
    as_json: Json = False,
) -> int:
    """Test a vision: the kit plays its robot at ENDPOINT; start the vision against it, before or after."""
    from sightline.conformance.vision import cases as side
    from sightline.protocol.conformance.strangers import RawZenoh
    from sightline.protocol.conformance.virtual import TO_ROBOT
    from sightline.protocol.transports.open import open_link

    cases = chosen(side.CASES, only or (), groups or ())
    if list_cases:
        typer.echo(listing(cases))
        return 0
    _check_files(junit, html, save)
    with ExitStack() as ending:
        access = access_for(secure, tokens or (), _ROLES[:1], ending)

        def open_it(role: str) -> Any:
            ends: dict[str, Any] = {"connect": [endpoint]} if dial else {"listen": [endpoint]}
            return open_link(robot, role=role, secure=access.folder, **ends)

        stranger = ending.enter_context(RawZenoh(endpoint, access.folder, "robot"))
        put = None if "://" in endpoint else stranger.put
        bench = ending.enter_context(
            LiveBench(robot, open_it, TO_ROBOT, put, roles=("robot",), endpoint=endpoint, access=access)
        )
        if not side.is_there(bench):
            raise LinkError(f"no vision answers robot {robot} at {endpoint}; start one, before or after this: "
                            f"sightline vision --connect {endpoint} --robot {robot}")
        tell = ending.enter_context(progress(len(cases)))
        results = run_cases(cases, bench, side.prepare, tell, TRIES)
    return _report(results, "vision", name or endpoint, (junit, html, save), as_json)


def codec(
    command: Annotated[list[str] | None, typer.Argument(metavar="-- COMMAND", help="The adapter.")] = None,
    *,
    only: Only = None,
    groups: Groups = None,
    list_cases: Listing = False,
    junit: Junit = None,
    html: Html = None,
    save: Save = None,
    name: Name = "",
    as_json: Json = False,
) -> int:
    """Test a codec in any language: a program that answers one line of JSON with one line of JSON."""
    from sightline.protocol.conformance import codec as side

    cases = chosen(side.CASES, only or (), groups or ())
    if list_cases:
        typer.echo(listing(cases))
        return 0
    if not command:
        raise ConfigError("no command: write it after two dashes, e.g. sightline conform codec -- node codec.js")
    _check_files(junit, html, save)
    with progress(len(cases)) as tell:
        results = side.run_codec(command, cases, tell)
    return _report(results, "codec", name or " ".join(command), (junit, html, save), as_json)


def page(
    runs: Annotated[list[Path], typer.Argument(metavar="FILE...", help="What --save wrote, one for each peer.")],
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write it here, e.g. docs/conformance.md.")] = None,
) -> None:
    """Make one Markdown page of several runs."""
    text = to_page([_read(path) for path in runs])
    if out is None:
        typer.echo(text)
    else:
        _check_files(out)
        out.write_text(text, "utf-8")


def _read(path: Path) -> dict[str, Any]:
    try:
        run = json.loads(path.read_text("utf-8"))
        return {name: run[name] for name in ("ok", "side", "peer", "counts", "checks")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        what = f"{path}: not a run of this kit ({type(error).__name__}); make one: sightline conform ... --save FILE"
        raise ConfigError(what) from None


def _check_files(*files: Path | None) -> None:
    """So that what cannot be written is known before the run. Raises ConfigError."""
    for path in files:
        if path is not None:
            check_out_file(path)


def _report(
    results: Sequence[Result], side: str, peer: str, files: tuple[Path | None, Path | None, Path | None], as_json: bool
) -> int:
    junit, html, save = files
    for path, text in (
        (junit, to_junit(results, side, peer)),
        (html, to_html(results, side, peer)),
        (save, json.dumps(to_dict(results, side, peer), indent=1) + "\n"),
    ):
        if path is not None:
            path.write_text(text, "utf-8")
    if as_json:
        typer.echo(json.dumps(to_dict(results, side, peer)))
    else:
        print_results(results)
    return 0 if passed(results) else CHECK_FAILED
