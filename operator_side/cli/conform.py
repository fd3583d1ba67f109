"""Commands that test a peer against the protocol: conform robot, vision, codec. Shell."""

import functools
import inspect
import json
import ssl
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from sightline.conformance.benches import LiveBench
from sightline.conformance.case import Access, Case, Level
from sightline.conformance.report import summary, to_dict, to_junit
from sightline.conformance.runner import Outcome, Result, chosen, run_cases
from sightline.operator_side.cli.options import print_result
from sightline.operator_side.preflight import check_out_file
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.security import own_token

_EXAMPLE = "e.g. --token vision=keys/vision.token"


def access_for(secure: str, tokens: Iterable[str], roles: Sequence[str], ending: ExitStack) -> Access:
    """Access with the folder `secure` and with `tokens`, each `ROLE=FILE`, or `FILE` for every one of `roles`.

    Tokens named beside a folder stand before those that lie in it. Raises ConfigError for one that cannot be used.
    """
    if secure and not Path(secure).expanduser().is_dir():
        raise ConfigError(f"--secure {secure}: there is no such folder; make keys with `sightline keys init {secure}`")
    given = _by_role(tokens, roles)
    if given:
        secure = _joined(secure, given, ending)
    own = {role: own_token(secure, role) for role in roles}
    return Access({role: token for role, token in own.items() if token}, secure)


def _by_role(tokens: Iterable[str], roles: Sequence[str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for named in tokens:
        role, equals, file = named.rpartition("=")
        if equals and role not in roles:
            raise ConfigError(f"--token {named}: there is no role {role!r} here, but {', '.join(roles)}; {_EXAMPLE}")
        found.update(dict.fromkeys([role] if role else roles, Path(file).expanduser()))
    return found


def _token_in(file: Path) -> str:
    try:
        return file.read_text("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is not text"
        raise ConfigError(f"--token {file} cannot be read: {why}; name a file that holds a token, {_EXAMPLE}") from None


def _joined(secure: str, tokens: dict[str, Path], ending: ExitStack) -> str:
    """A folder with the files of `secure` and these tokens in place of its own, gone at the end."""
    folder = Path(ending.enter_context(tempfile.TemporaryDirectory(prefix="sightline-conform-")))
    for file in Path(secure).expanduser().iterdir() if secure else _trusted_here():
        (folder / (file.name if secure else "ca.pem")).symlink_to(file.absolute())
    for role, given in tokens.items():
        own = folder / f"{role}.token"
        own.unlink(missing_ok=True)
        own.touch(mode=0o600)
        own.write_text(_token_in(given), "ascii")
        try:
            own_token(str(folder), role)
        except ConfigError:
            raise ConfigError(f"--token {given} holds no token: 16 to 128 of A-Z a-z 0-9 _ -; {_EXAMPLE}") from None
    return str(folder)


def _trusted_here() -> list[Path]:
    """The authorities that this machine trusts, for a `wss://` whose certificate needs no folder."""
    file = ssl.get_default_verify_paths().cafile
    return [Path(file)] if file else []


# How `sightline conform` shows itself: a bar on stderr while it runs, then a table by group. Shell (a terminal).


_FEW: Final = 3
"""So many that lack the same and more are one line."""
_COLOURS: Final = {Outcome.PASSED: "green", Outcome.FAILED: "red", Outcome.SKIPPED: "dim"}


@contextmanager
def progress(total: int) -> Iterator[Callable[[Result], None]]:
    """A bar over `total` cases with what has failed above it; a line per failure where stderr is not a terminal."""
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), console=console, transient=True,
        disable=not console.is_terminal,
    ) as bar:  # fmt: skip
        task = bar.add_task("cases", total=total)

        def show(result: Result) -> None:
            bar.update(task, advance=1, description=result.case.id)
            if result.outcome is Outcome.FAILED:
                console.print(f"{result.case.id}: {result.reason}", markup=False, highlight=False)

        yield show


def print_results(results: Sequence[Result]) -> None:
    """The table on stdout, group by group, with the reason of whatever did not pass; then the summary."""
    console = Console()
    table = Table(box=None, pad_edge=False, show_header=False)
    for _ in range(4):
        table.add_column()
    for group, members in groupby(results, lambda one: one.case.group):
        listed = list(members)
        good = sum(one.outcome is Outcome.PASSED for one in listed)
        table.add_row(f"[bold]{group}[/bold]", "", "", f"[bold]{good} of {len(listed)} passed[/bold]")
        for alike in _alike(listed):
            table.add_row(*_row(alike[0]) if len(alike) < _FEW else _row_of_many(alike))
            for one in alike[1:] if len(alike) < _FEW else ():
                table.add_row(*_row(one))
    console.print(table)
    console.print(summary(results), markup=False, highlight=False)


def _alike(results: Sequence[Result]) -> Iterator[list[Result]]:
    """Neighbours that are not applicable for the same reason together, every other case alone."""

    def sort(numbered: tuple[int, Result]) -> tuple[int, str]:
        number, one = numbered
        return (-1, one.reason) if one.outcome is Outcome.SKIPPED else (number, "")

    for _sort, members in groupby(enumerate(results), sort):
        yield [one for _, one in members]


def _row_of_many(alike: Sequence[Result]) -> tuple[str, str, str, str]:
    reported = f"{len(alike)} cases, to {alike[-1].case.id}\n[dim]{escape(alike[0].reason)}[/dim]"
    return f"  {alike[0].case.id}", "", f"[dim]{Outcome.SKIPPED.value}[/dim]", reported


def _row(one: Result) -> tuple[str, str, str, str]:
    weak = one.outcome is Outcome.FAILED and one.case.level is Level.SHOULD
    colour = "yellow" if weak else _COLOURS[one.outcome]
    reported = f"\n[dim]{escape(one.reason)}[/dim]" if one.reason else ""
    outcome = f"[{colour}]{one.outcome.value}[/{colour}]"
    return f"  {one.case.id}", one.case.level.value, outcome, f"{escape(one.case.title)}{reported}"


def listing(cases: Sequence[Case]) -> str:
    """Every case in a line, for `--list`."""
    return "\n".join(
        f"{case.id:<12} {case.level.value:<6} {case.group:<14} {case.title} [{case.clause}]" for case in cases
    )


# The commands `conform robot | vision | codec | page`: does any peer speak the protocol, point by point. Shell.


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
    list[str] | None, typer.Option("--token", metavar="FILE", help="File with the WebSocket token to request.")
]
Junit = Annotated[Path | None, typer.Option("--junit", metavar="FILE", help="Write JUnit XML, for a CI.")]
Save = Annotated[Path | None, typer.Option("--save", metavar="FILE", help="Write the JSON to a file too.")]
Name = Annotated[str, typer.Option("--name", metavar="TEXT", help="The peer's name in reports [default: where it is].")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")]


@dataclass(frozen=True)
class RunOptions:
    """Which cases run, and where their results go: the options that each command has."""

    only: Only = None
    groups: Groups = None
    list_cases: Listing = False
    junit: Junit = None
    save: Save = None
    name: Name = ""
    as_json: Json = False

    def chosen(self, cases: Sequence[Case]) -> Sequence[Case]:
        """Those of `cases` to run; none once listed. Raises ConfigError for a file that cannot be written."""
        found = chosen(cases, self.only or (), self.groups or ())
        if self.list_cases:
            typer.echo(listing(found))
            return ()
        for path in filter(None, (self.junit, self.save)):
            check_out_file(path)
        return found

    def report(self, results: Sequence[Result], side: str, peer: str) -> int:
        """Print and write the results. Returns the exit code."""
        found = to_dict(results, side, self.name or peer)
        if self.junit is not None:
            self.junit.write_text(to_junit(results, side, self.name or peer), "utf-8")
        if self.save is not None:
            self.save.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
        if not self.as_json:
            print_results(results)
        return print_result(found, (), self.as_json)


def with_run_options(command: Callable[..., int]) -> Callable[..., int]:
    """`command(..., run=RunOptions)` as a command that has each field of RunOptions as an option of its own."""
    fields = inspect.signature(RunOptions).parameters

    @functools.wraps(command)
    def with_options(*arguments: Any, **options: Any) -> int:
        run = RunOptions(**{name: options.pop(name) for name in fields})
        return command(*arguments, run=run, **options)

    own = [parameter for parameter in inspect.signature(command).parameters.values() if parameter.name != "run"]
    shared = [field.replace(kind=inspect.Parameter.KEYWORD_ONLY) for field in fields.values()]
    with_options.__signature__ = inspect.Signature([*own, *shared])  # type: ignore[attr-defined]
    with_options.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *shared)}
    del with_options.__wrapped__
    return with_options


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(
        help="Test any robot, vision or codec against the wire protocol, case by case.",
        no_args_is_help=False, rich_markup_mode=None,
    )  # fmt: skip
    group.command(epilog="Example: sightline conform robot ws://192.168.1.20:9090")(with_run_options(robot))
    group.command(epilog="Example: sightline conform vision tcp/127.0.0.1:7447")(with_run_options(vision))
    group.command(epilog="Example: sightline conform codec -- node codec.js")(with_run_options(codec))
    app.add_typer(group, name="conform")


def robot(
    endpoint: Annotated[str, typer.Argument(metavar="ENDPOINT", help="Where it listens: tcp/..., ws:// or wss://.")],
    *,
    robot: Robot = "r1",
    legacy: Annotated[
        str, typer.Option("--older", metavar="ENDPOINT", help="Its legacy protocol's port, ws-legacy://HOST:9091.")
    ] = "",
    secure: Secure = "",
    tokens: Tokens = None,
    run: RunOptions,
) -> int:
    """Test a robot as its driver, its watcher and its enemy. It is armed and its wheels turn: lift it off the floor."""
    from sightline.conformance.benches import FROM_ROBOT
    from sightline.conformance.raw_peers import RawZenoh
    from sightline.conformance.robot import cases as side
    from sightline.conformance.robot.websocket import put_over_websocket
    from sightline.protocol.transports.open import open_link

    cases = run.chosen(side.CASES)
    if not cases:
        return 0
    with ExitStack() as ending:
        access = access_for(secure, tokens or (), _ROLES, ending)

        def open_it(role: str) -> Any:
            return open_link(robot, connect=[endpoint], role=role, secure=access.folder)

        def put_it(key: str, header: bytes, payload: bytes) -> None:
            put_over_websocket(bench, key, header, payload)

        put = put_it if "://" in endpoint else ending.enter_context(RawZenoh(endpoint, access.folder)).put
        roles = _ROLES if access.is_guarded else _ROLES[:1]
        bench = LiveBench(
            robot, open_it, FROM_ROBOT, put, roles=roles, endpoint=endpoint, legacy=legacy, access=access
        )  # fmt: skip
        ending.enter_context(bench)
        if not side.is_there(bench):
            raise LinkError(f"{endpoint} answers, but no robot {robot} publishes its status there; check --robot")
        show_result = ending.enter_context(progress(len(cases)))
        results = run_cases(cases, bench, side.prepare, show_result, TRIES)
    return run.report(results, "robot", endpoint)


def vision(
    endpoint: Annotated[str, typer.Argument(metavar="ENDPOINT", help="Where the kit listens, as a robot would.")],
    *,
    robot: Robot = "r1",
    dial: Annotated[
        bool, typer.Option("--dial", help="Connect to a vision service or router that listens there.")
    ] = False,
    secure: Secure = "",
    tokens: OwnToken = None,
    run: RunOptions,
) -> int:
    """Test a vision service: the kit plays its robot at ENDPOINT; start the service against it, before or after."""
    from sightline.conformance.benches import TO_ROBOT
    from sightline.conformance.raw_peers import RawZenoh
    from sightline.conformance.vision import cases as side
    from sightline.protocol.transports.open import open_link

    cases = run.chosen(side.CASES)
    if not cases:
        return 0
    with ExitStack() as ending:
        access = access_for(secure, tokens or (), _ROLES[:1], ending)

        def open_it(role: str) -> Any:
            ends: dict[str, Any] = {"connect": [endpoint]} if dial else {"listen": [endpoint]}
            return open_link(robot, role=role, secure=access.folder, **ends)

        third_party = ending.enter_context(RawZenoh(endpoint, access.folder, "robot"))
        put = None if "://" in endpoint else third_party.put
        bench = ending.enter_context(
            LiveBench(robot, open_it, TO_ROBOT, put, roles=("robot",), endpoint=endpoint, access=access)
        )
        if not side.is_there(bench):
            raise LinkError(f"no vision answers robot {robot} at {endpoint}; start one, before or after this: "
                            f"sightline vision --connect {endpoint} --robot {robot}")
        show_result = ending.enter_context(progress(len(cases)))
        results = run_cases(cases, bench, side.prepare, show_result, TRIES)
    return run.report(results, "vision", endpoint)


def codec(
    command: Annotated[list[str] | None, typer.Argument(metavar="-- COMMAND", help="The adapter.")] = None,
    *,
    run: RunOptions,
) -> int:
    """Test a codec in any language: a program that answers one line of JSON with one line of JSON."""
    from sightline.conformance import codec as side

    cases = run.chosen(side.CASES)
    if not cases:
        return 0
    if not command:
        raise ConfigError("no command: write it after two dashes, e.g. sightline conform codec -- node codec.js")
    with progress(len(cases)) as show_result:
        results = side.run_codec(command, cases, show_result)
    return run.report(results, "codec", " ".join(command))
