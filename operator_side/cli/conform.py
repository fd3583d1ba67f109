"""Commands that test a peer against the protocol: conform robot, vision, codec. Shell."""

import copy
import functools
import inspect
import json
import ssl
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from sightline.conformance.benches import LiveBench
from sightline.conformance.case import Access, Case, NotApplicableError
from sightline.conformance.jobs import Jobs
from sightline.conformance.measured import WheelRow, check_motor_log, read_motor_log
from sightline.conformance.raw_peers import BINARY, CLOSE
from sightline.conformance.report import LINE_START, from_lines, summary, to_dict, to_junit, to_line
from sightline.conformance.robot.fixture import Robot as RobotUnderTest
from sightline.conformance.runner import Outcome, Result, chosen, printable, run_cases
from sightline.operator_side.cli.options import Json, Secure, command_group, print_result
from sightline.operator_side.preflight import check_out_file, writes
from sightline.operator_side.table import print_table, table_lines
from sightline.protocol.channels import STATUS
from sightline.protocol.errors import ConfigError, LinkError, WireError, home_path
from sightline.protocol.transports.endpoints import parse_websocket_endpoint
from sightline.protocol.transports.security import own_token
from sightline.protocol.transports.websocket.framing import unpack

_EXAMPLE = "e.g. --token vision=keys/vision.token"


def access_for(secure: str, tokens: Iterable[str], roles: Sequence[str], ending: ExitStack) -> Access:
    """Combine the folder `secure` with `tokens`, each `ROLE=FILE`, or `FILE` for all `roles`.

    A given token replaces that of the folder. Raises ConfigError for an unusable token.
    """
    if secure and not home_path(secure).is_dir():
        raise ConfigError(f"--secure {secure}: folder not found; create keys with `sightline keys init {secure}`")
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
            raise ConfigError(f"--token {named}: unknown role '{role}', expected {', '.join(roles)}; {_EXAMPLE}")
        found.update(dict.fromkeys([role] if role else roles, home_path(file)))
    return found


def _token_in(file: Path) -> str:
    try:
        return file.read_text("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not a text file"
        raise ConfigError(f"cannot read --token {file}: {why}; name a file with a token, {_EXAMPLE}") from None


def _joined(secure: str, tokens: dict[str, Path], ending: ExitStack) -> str:
    """Create a temporary folder with the files of `secure`, and with these tokens in place of its own tokens."""
    folder = Path(ending.enter_context(tempfile.TemporaryDirectory(prefix="sightline-conform-")))
    for file in home_path(secure).iterdir() if secure else _trusted_here():
        (folder / (file.name if secure else "ca.pem")).symlink_to(file.absolute())
    for role, given in tokens.items():
        own = folder / f"{role}.token"
        own.unlink(missing_ok=True)
        own.touch(mode=0o600)
        own.write_text(_token_in(given), "ascii")
        try:
            own_token(str(folder), role)
        except ConfigError:
            raise ConfigError(
                f"--token {given}: invalid token, expected 16 to 128 of A-Z a-z 0-9 _ -; {_EXAMPLE}"
            ) from None
    return str(folder)


def _trusted_here() -> list[Path]:
    """Return the authorities that this machine trusts, for a `wss://` certificate without a folder."""
    file = ssl.get_default_verify_paths().cafile
    return [Path(file)] if file else []


# --- output: a progress bar on stderr, then a table by group -----------------------------------------------------


_FEW: Final = 3
"""Number of cases with the same skip reason from which they share one line."""


@contextmanager
def progress(total: int, every: bool = False) -> Iterator[Callable[[Result], None]]:
    """Show a progress bar over `total` cases, and above it the failures, or every case if `every` is True."""
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), console=console, transient=True,
        disable=not console.is_terminal,
    ) as bar:  # fmt: skip
        task = bar.add_task("cases", total=total)

        def show(result: Result) -> None:
            bar.update(task, advance=1, description=result.case.id)
            for line in _lines_of(result, every):
                console.print(line, markup=False, highlight=False, soft_wrap=True)

        yield show


def _lines_of(result: Result, every: bool) -> Iterator[str]:
    """Yield the lines of a finished case: one line, and after a failure the clause and the last messages."""
    case = result.case
    if result.outcome is Outcome.FAILED:
        yield f"{case.id}: {result.reason}" + (f" [{case.clause}]" if every else "")
        yield from (f"    {line}" for line in result.evidence)
    elif every:
        reason = f": {result.reason}" if result.reason else ""
        yield f"{case.id} {result.outcome.value}, {result.took_us / 1e6:.1f} s{reason}"


def print_results(results: Sequence[Result]) -> None:
    """Print a table by group, with the reason of each case that did not pass; then the summary."""
    rows: list[tuple[str, str, str, str]] = []
    for group, members in groupby(results, lambda one: one.case.group):
        listed = list(members)
        good = sum(one.outcome is Outcome.PASSED for one in listed)
        rows.append((group, "", "", f"{good} of {len(listed)} passed"))
        for alike in _alike(listed):
            if len(alike) < _FEW:
                rows += [row for one in alike for row in _rows_of(one)]
            else:
                rows += _rows_of_many(alike)
    print_table(rows)
    typer.echo(summary(results))


def _alike(results: Sequence[Result]) -> Iterator[list[Result]]:
    """Group neighbors that are skipped for the same reason. Every other case is a separate group."""

    def sort(numbered: tuple[int, Result]) -> tuple[int, str]:
        number, one = numbered
        return (-1, one.reason) if one.outcome is Outcome.SKIPPED else (number, "")

    for _sort, members in groupby(enumerate(results), sort):
        yield [one for _, one in members]


def _rows_of_many(alike: Sequence[Result]) -> Iterator[tuple[str, str, str, str]]:
    yield f"  {alike[0].case.id}", "", Outcome.SKIPPED.value, f"{len(alike)} cases, to {alike[-1].case.id}"
    yield "", "", "", alike[0].reason


def _rows_of(one: Result) -> Iterator[tuple[str, str, str, str]]:
    yield f"  {one.case.id}", one.case.level.value, one.outcome.value, one.case.title
    if one.reason:
        yield "", "", "", one.reason


def listing(cases: Sequence[Case]) -> str:
    """Format every case as a line, for `--list`."""
    return "\n".join(
        table_lines((case.id, case.level.value, case.group, f"{case.title} [{case.clause}]") for case in cases)
    )


# --- the commands ------------------------------------------------------------------------------------------------


_ROLES = ("vision", "operator")
"""Roles that the kit plays, if each role has its own keys."""
_SEEN_S = 1.0
"""Time for which a robot without a status is observed again."""
TRIES = 3
"""Attempts of a case before it fails, because a network may lose a message, and a machine may be busy."""

Only = Annotated[
    list[str] | None, typer.Option("--only", metavar="ID", help="A case, or the prefix of several: R-CAUS; repeatable.")
]
Groups = Annotated[list[str] | None, typer.Option("--group", metavar="NAME", help="A group such as lease; repeatable.")]
Listing = Annotated[bool, typer.Option("--list", help="List the cases and their demands; test nothing.")]
Robot = Annotated[str, typer.Option("--robot", metavar="ID", help="Robot id.")]
Tokens = Annotated[
    list[str] | None,
    typer.Option(
        "--token", metavar="[ROLE=]FILE",
        help="File with the WebSocket token of vision, operator or both; repeatable.",
    ),
]  # fmt: skip
OwnToken = Annotated[
    list[str] | None, typer.Option("--token", metavar="FILE", help="File with the required WebSocket token.")
]
Junit = Annotated[Path | None, typer.Option("--junit", metavar="FILE", help="Write JUnit XML.")]
Save = Annotated[Path | None, typer.Option("--save", metavar="FILE", help="Also write the JSON to a file.")]
JsonLines = Annotated[
    bool, typer.Option("--json-lines", help="Print the result of each case as one line of JSON, as it ends.")
]
Resume = Annotated[
    Path | None,
    typer.Option("--resume", metavar="FILE", help="Append each result to FILE, and skip the cases that it has."),
]
JobCount = Annotated[int, typer.Option("--jobs", min=1, max=16, help="Peers that the kit starts and tests at once.")]
Start = Annotated[
    str, typer.Option("--start", metavar="COMMAND", help="Start the peer; {endpoint} and {job} are replaced.")
]
Name = Annotated[str, typer.Option("--name", metavar="TEXT", help="Peer's name in reports [default: its address].")]


@dataclass(frozen=True)
class RunOptions:
    """The common options of the commands: the cases to run, and the result files."""

    only: Only = None
    groups: Groups = None
    list_cases: Listing = False
    junit: Junit = None
    save: Save = None
    name: Name = ""
    as_json: Json = False
    json_lines: JsonLines = False
    resume: Resume = None
    jobs: JobCount = 1
    start: Start = ""

    def chosen(self, cases: Sequence[Case]) -> Sequence[Case]:
        """Return the cases to run; empty after --list. Raises ConfigError for a file that cannot be written."""
        found = chosen(cases, self.only or (), self.groups or ())
        if self.list_cases:
            typer.echo(listing(found))
            return ()
        for path in filter(None, (self.junit, self.save, self.resume)):
            check_out_file(path)
        return found

    def earlier(self, cases: Sequence[Case], side: str, peer: str) -> list[Result]:
        """Read the results in the file of --resume. Raises ConfigError for a damaged file or another peer."""
        if self.resume is None or not self.resume.exists():
            return []
        try:
            text = self.resume.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            why = getattr(error, "strerror", None) or "not a text file"
            raise ConfigError(f"cannot read --resume {self.resume}: {why}; name another file") from None
        whole = text[: text.rfind("\n") + 1]
        results = from_lines(whole, cases, side, self.name or peer, str(self.resume))
        if whole != text:  # a killed run may leave half a line, which must be removed before new lines
            if not whole and not text.startswith(LINE_START):
                raise ConfigError(f"--resume {self.resume} has no results; name another file")
            self.resume.write_text(whole, "utf-8")
        return results

    @contextmanager
    def shown(self, total: int, side: str, peer: str) -> Iterator[Callable[[Result], None]]:
        """Show each result when its case ends, and write it for --json-lines and --resume."""
        with ExitStack() as ending:
            show = ending.enter_context(progress(total, every=side != "codec"))
            store = ending.enter_context(self.resume.open("a", encoding="utf-8", buffering=1)) if self.resume else None

            def on_result(result: Result) -> None:
                show(result)
                line = to_line(result, side, self.name or peer)
                if store is not None:
                    store.write(line + "\n")
                if self.json_lines:
                    typer.echo(line)

            yield on_result

    def in_jobs(
        self, cases: Sequence[Case], side: str, endpoint: str, options: Mapping[str, Sequence[str]]
    ) -> list[Result] | None:
        """Run the cases against peers that the kit starts. Returns None without --jobs and --start.

        Each kit process receives the `options`: name -> values.
        """
        if self.jobs == 1 and not self.start:
            return None
        more = [part for name, values in options.items() for value in values if value for part in (name, value)]
        jobs = Jobs(side, endpoint, self.start, self.jobs, more)
        with self.shown(len(cases), side, endpoint) as show_result:
            return jobs.run(cases, show_result)

    def check_one_peer(self, alone: Mapping[str, object]) -> None:
        """Raise ConfigError if --jobs or --start is combined with an option for a single peer."""
        given = [name for name, value in alone.items() if value]
        if given and (self.jobs > 1 or self.start):
            raise ConfigError(f"{given[0]} is for one peer; leave out --jobs and --start")

    def report(self, results: Sequence[Result], side: str, peer: str) -> int:
        """Print and write the results. Returns the exit code; raises ConfigError if a file cannot be written."""
        found = to_dict(results, side, self.name or peer)
        if not self.as_json and not self.json_lines:
            print_results(results)
        code = print_result(found, (), self.as_json)
        if self.junit is not None:
            with writes(self.junit):
                self.junit.write_text(to_junit(results, side, self.name or peer), "utf-8")
        if self.save is not None:
            with writes(self.save):
                self.save.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
        return code


def _in_order(cases: Sequence[Case], *parts: Sequence[Result]) -> list[Result]:
    """Join earlier and new results in the order of the cases. Of two results for a case the last one counts."""
    by_id = {one.case.id: one for part in parts for one in part}
    return [by_id[case.id] for case in cases if case.id in by_id]


def _left(cases: Sequence[Case], earlier: Sequence[Result]) -> list[Case]:
    done = {one.case.id for one in earlier}
    return [case for case in cases if case.id not in done]


def _need_endpoint(endpoint: str, example: str, legacy: str = "") -> None:
    if not endpoint:
        raise ConfigError(f"no ENDPOINT; write its address, e.g. sightline conform {example}")
    if legacy and parse_websocket_endpoint(legacy).legacy is None:
        raise ConfigError(f"invalid --older {legacy}: expected ws-legacy://HOST:PORT, e.g. ws-legacy://127.0.0.1:9091")


def _motor_rows(file: Path) -> list[WheelRow]:
    try:
        return read_motor_log(file.read_text("ascii"), str(file))
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not a text file"
        raise ConfigError(f"cannot read --motor-log {file}: {why}; name the file of the robot's drive") from None


def _use_motor_log(bench: LiveBench, file: Path | None) -> None:
    """Let the cases read the robot's motor log. Raises ConfigError for a log of another run."""
    if file is not None:
        t_us = RobotUnderTest(bench).stamp().t_us
        check_motor_log(_motor_rows(file), t_us, bench.robot, str(file))
        bench.motor_rows = lambda: [row for row in _motor_rows(file) if row.t_us >= t_us]


def _seen_of(bench: LiveBench) -> str:
    """Return the behavior of a robot without a status, as a second connection of the kit observes it."""
    from sightline.conformance.robot.websocket import spoken

    with suppress(NotApplicableError, LinkError), spoken(bench, STATUS.name) as raw:
        frame = raw.frame_that(lambda one: one.opcode in (BINARY, CLOSE), _SEEN_S)
        if frame is not None and frame.opcode == CLOSE:
            reason = printable(frame.data[2:].decode("utf-8", "replace"))
            return f"it ends the connection with {int.from_bytes(frame.data[:2])} {reason}".rstrip()
        if frame is not None:
            try:
                unpack(frame.data, bench.robot, "")
            except WireError as error:
                return f"its messages are invalid: {error.detail}"
    rejected = ", ".join(sorted(bench.dropped_here))
    return f"its messages are rejected: {rejected}" if rejected else "check --robot, or publish status"


def with_run_options(command: Callable[..., int], rejects: Sequence[str] = ()) -> Callable[..., int]:
    """Turn `command(..., run=RunOptions)` into a command with an option for each field of RunOptions.

    The help does not list the options that the command `rejects`.
    """
    fields = inspect.signature(RunOptions).parameters

    @functools.wraps(command)
    def with_options(*arguments: Any, **options: Any) -> int:
        run = RunOptions(**{name: options.pop(name) for name in fields})
        return command(*arguments, run=run, **options)

    own = [parameter for parameter in inspect.signature(command).parameters.values() if parameter.name != "run"]
    shared = [field.replace(kind=inspect.Parameter.KEYWORD_ONLY) for field in fields.values()]
    shared = [_unlisted(field) if field.name in rejects else field for field in shared]
    with_options.__signature__ = inspect.Signature([*own, *shared])  # type: ignore[attr-defined]
    with_options.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *shared)}
    del with_options.__wrapped__
    return with_options


def _unlisted(option: inspect.Parameter) -> inspect.Parameter:
    kind, shown = option.annotation.__origin__, copy.copy(option.annotation.__metadata__[0])
    shown.hidden = True
    return option.replace(annotation=Annotated[kind, shown])


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = command_group("Test a robot, vision service or codec against the protocol")
    group.command(epilog="Example: sightline conform robot ws://192.168.1.20:9090")(with_run_options(robot))
    group.command(epilog="Example: sightline conform vision tcp/127.0.0.1:7447")(with_run_options(vision))
    group.command(epilog="Example: sightline conform codec -- node codec.js")(
        with_run_options(codec, rejects=("jobs", "start"))
    )
    app.add_typer(group, name="conform")


def robot(
    endpoint: Annotated[str, typer.Argument(metavar="ENDPOINT", help="Its address: tcp/..., ws:// or wss://.")] = "",
    *,
    robot: Robot = "r1",
    legacy: Annotated[
        str, typer.Option("--older", metavar="ENDPOINT", help="Its legacy port, ws-legacy://HOST:9091.")
    ] = "",
    secure: Secure = "",
    tokens: Tokens = None,
    motor_log: Annotated[
        Path | None,
        typer.Option("--motor-log", metavar="FILE", help="The robot's motor log, a second witness of its motion."),
    ] = None,
    run: RunOptions,
) -> int:
    """Test a robot against the protocol

    The kit arms the robot and turns its wheels, so lift it off the floor. It plays drivers, viewers and attackers.
    """
    from sightline.conformance.benches import FROM_ROBOT
    from sightline.conformance.raw_peers import RawZenoh
    from sightline.conformance.robot import cases as side
    from sightline.conformance.robot.websocket import put_over_websocket
    from sightline.protocol.transports.open import open_link

    cases = run.chosen(side.CASES)
    if not cases:
        return 0
    _need_endpoint(endpoint, "robot ws://192.168.1.20:9090", legacy)
    run.check_one_peer({"--older": legacy, "--motor-log": motor_log})
    earlier = run.earlier(cases, "robot", endpoint)
    left = _left(cases, earlier)
    options = {"--robot": [robot], "--secure": [secure], "--token": tokens or []}
    if (found := run.in_jobs(left, "robot", endpoint, options)) is not None:
        return run.report(_in_order(cases, earlier, found), "robot", endpoint)
    with ExitStack() as ending:
        access = access_for(secure, tokens or (), _ROLES, ending)

        def open_it(role: str) -> Any:
            return open_link(robot, connect=[endpoint], role=role, secure=access.folder)

        def put_it(key: str, header: bytes, payload: bytes) -> None:
            put_over_websocket(bench, key, header, payload)

        third_party = None if "://" in endpoint else ending.enter_context(RawZenoh(endpoint, access.folder))
        put = put_it if third_party is None else third_party.put
        roles = _ROLES if access.is_guarded else _ROLES[:1]
        if motor_log is not None:
            _motor_rows(motor_log)
        bench = LiveBench(
            robot, open_it, FROM_ROBOT, put, third_party=third_party, roles=roles, endpoint=endpoint, legacy=legacy,
            access=access,
        )
        ending.enter_context(bench)
        if not side.is_there(bench):
            raise LinkError(f"no status from robot '{robot}' at {endpoint}; {_seen_of(bench)}")
        _use_motor_log(bench, motor_log)
        show_result = ending.enter_context(run.shown(len(left), "robot", endpoint))
        results = run_cases(left, bench, side.prepare, show_result, TRIES)
    return run.report(_in_order(cases, earlier, results), "robot", endpoint)


def vision(
    endpoint: Annotated[str, typer.Argument(metavar="ENDPOINT", help="Address on which the kit listens.")] = "",
    *,
    robot: Robot = "r1",
    dial: Annotated[
        bool, typer.Option("--dial", help="Connect to a vision service or router at ENDPOINT.")
    ] = False,
    secure: Secure = "",
    tokens: OwnToken = None,
    run: RunOptions,
) -> int:
    """Test a vision service against the protocol

    The kit plays the robot at ENDPOINT. Start the vision service with --connect ENDPOINT, before or after.
    """
    from sightline.conformance.benches import TO_ROBOT
    from sightline.conformance.raw_peers import RawZenoh
    from sightline.conformance.vision import cases as side
    from sightline.protocol.transports.open import open_link

    cases = run.chosen(side.CASES)
    if not cases:
        return 0
    _need_endpoint(endpoint, "vision tcp/127.0.0.1:7447")
    run.check_one_peer({"--dial": dial})
    earlier = run.earlier(cases, "vision", endpoint)
    left = _left(cases, earlier)
    options = {"--robot": [robot], "--secure": [secure], "--token": tokens or []}
    if (found := run.in_jobs(left, "vision", endpoint, options)) is not None:
        return run.report(_in_order(cases, earlier, found), "vision", endpoint)
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
            raise LinkError(f"no answer from a vision service for robot '{robot}' at {endpoint}; run "
                            f"`sightline vision --connect {endpoint} --robot {robot}`")
        show_result = ending.enter_context(run.shown(len(left), "vision", endpoint))
        results = run_cases(left, bench, side.prepare, show_result, TRIES)
    return run.report(_in_order(cases, earlier, results), "vision", endpoint)


def codec(
    command: Annotated[
        list[str] | None, typer.Argument(metavar="-- COMMAND", help="Program that answers the cases.")
    ] = None,
    *,
    run: RunOptions,
) -> int:
    """Test a codec in any language against the protocol

    The program answers each line of JSON with one line of JSON.
    """
    from sightline.conformance import codec as side

    cases = run.chosen(side.CASES)
    if not cases:
        return 0
    if not command:
        raise ConfigError("no command; write it after two dashes, e.g. sightline conform codec -- node codec.js")
    run.check_one_peer({"conform codec": True})
    peer = " ".join(command)
    earlier = run.earlier(cases, "codec", peer)
    left = _left(cases, earlier)
    with run.shown(len(left), "codec", peer) as show_result:
        results = side.run_codec(command, left, show_result)
    return run.report(_in_order(cases, earlier, results), "codec", peer)
