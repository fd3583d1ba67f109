"""Write the pages that are generated from the code: commands, exit codes, rejections, settings, detector card.

    python -m docs.make.reference            # write the pages
    python -m docs.make.reference --check    # print the outdated pages; exit code 5 if there is one
"""

import ast
import inspect
import itertools
import json
import math
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import click
import typer

from sightline.operator_side.cli.commands import COMMANDS, EXIT_CODES, app
from sightline.operator_side.cli.options import CHECK_FAILED
from sightline.operator_side.config.loading import SERVICES, model_of
from sightline.operator_side.teleop.control import LAYOUTS
from sightline.protocol.config import Config
from sightline.protocol.errors import CLAMPED, RejectReason

ROOT: Final = Path(__file__).parents[2]
REFERENCE: Final = ROOT / "docs" / "reference"
NOTE: Final = "<!-- Written by `python -m docs.make.reference`; do not edit. -->\n"
REMEDIES: Final = {
    "MALFORMED": ("The message does not follow the protocol.", "Run `sightline conform` against the peer."),
    "UNSUPPORTED_VERSION": ("The header has another protocol version.", "Install the same release on both machines."),
    "NOT_FINITE": ("A speed is nan, inf or too large.", "Correct the controller."),
    "UNKNOWN_SOURCE": ("The role is unknown, differs from the key, or guests are off.",
                       "Use a known role; `safety.guests` permits guests."),
    "OTHER_SESSION": ("The command cites a frame of an earlier robot start, or a STOP datagram is of one.",
                      "None: the next frame or datagram ends it."),
    "UNKNOWN_FRAME": ("The command cites a frame that this robot did not issue.",
                      "Cite `session`, `seq` and `t_us` exactly as received."),
    "FROM_FUTURE": ("The command cites a capture time later than now.", "Copy `t_us` from the frame."),
    "STALE": ("The frame behind the command is too old.",
              "See [slow links](../how-to/troubleshooting.md#the-robot-is-slow-or-stops)."),
    "OUT_OF_ORDER": ("`seq` is not newer than the last one of this source and session.", "Count up by one."),
    "NOT_PROVEN": (
        "The command states the driver's session without continuing its proof, or a robot with keys gets no proof.",
        "Another peer copied the identity of the driver. A peer of an older version needs an update.",
    ),
    "NOT_HOLDER": ("Another driver holds the lease.", "`sightline status` names the driver."),
    "DISARMED": ("The command is valid, but the robot is disarmed.", "Run `sightline arm`."),
    "STOPPED": ("The STOP latch is set.", "Run `sightline reset`, then `sightline arm`."),
    "FAULT": ("The drive reports a fault.", "Repair the drive, then run `sightline reset`."),
    "NOT_ALLOWED": ("This source may not make this request now.",
                    "Another operator holds the lease, or the role forbids it."),
    "OTHER_ROBOT": ("A STOP datagram is for another robot.", "Pass the robot's id and address to `sightline stop`."),
    "WRONG_KEY": ("A STOP datagram has no HMAC of this robot's STOP secret.",
                  "Copy `stop.secret` of one key folder to robots and operators."),
}
README_TABLES: Final = {
    "en": """| measured | result |
|---|---|
| {total} injected faults (vision killed, Wi-Fi lost ...) \
| {passed} pass; worst stop {stop_s:.2f} s, {stop_m:.2f} m (limits 0.7 s, 0.25 m) |
| figure of eight, +50 ms, 10 % loss | bearing error {eight_deg:.2f} degrees RMS, worst of 6 starts |
| 80 ms detector at 30 fps \
| commands {ours_ms:.0f} ms old (plain Zenoh callback, same detector: {callback_s:.0f} s and growing) |
""",
    "zh": """| 测量项目 | 结果 |
|---|---|
| 注入 {total} 种故障（视觉进程被杀、Wi-Fi 断开……） \
| 通过 {passed} 种；最差停车 {stop_s:.2f} 秒、{stop_m:.2f} 米（上限 0.7 秒、0.25 米） |
| 8 字形路线，延迟 +50 ms，丢包 10 % | 方位误差均方根 {eight_deg:.2f} 度（6 次起步中最差） |
| 检测器耗时 80 ms，30 帧/秒 \
| 指令龄期 {ours_ms:.0f} ms（普通 Zenoh 回调加同一检测器：{callback_s:.0f} 秒，且持续增长） |
""",
}
Bounds = Mapping[str, Any]
WORDS: Final = {"exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "to"}


def cell(text: str) -> str:
    """Return `text` as one cell of a table."""
    return " ".join(text.replace("|", "\\|").split())


def commands(command: click.Command, name: str) -> Iterator[tuple[str, click.Command]]:
    """Yield each command below `command` with its full name, in the order of the help."""
    for sub, one in getattr(command, "commands", {}).items():
        yield f"{name} {sub}", one
        yield from commands(one, f"{name} {sub}")


def option_rows(command: click.Command) -> Iterator[str]:
    """Yield one table row per argument and option."""
    for parameter in command.params:
        help_text = getattr(parameter, "help", None) or ""
        if getattr(parameter, "hidden", False):
            continue
        names = ", ".join(f"`{name}`" for name in parameter.opts + parameter.secondary_opts)
        if parameter.param_type_name == "argument":
            pieces = " ".join(parameter.get_usage_pieces(click.Context(command)))
            names = f"`{re.sub(r'[][{}]', '', pieces).rstrip('.').strip().replace('|', ' or ')}`"
        default = parameter.default
        shown = "" if default in (None, "", (), []) or default is False or callable(default) else f"`{default}`"
        yield f"| {names} | {shown} | {cell(help_text)} |"


def cli_page() -> str:
    """Return the page of all commands with their options."""
    root = typer.main.get_command(app)
    parts = [NOTE, "# Command line\n",
             "This page lists each command with its options. `sightline COMMAND --help` prints the same text. "
             "After `sightline --install-completion`, the Tab key completes commands, options and names in a new "
             "terminal. "
             "[Exit codes](exit-codes.md) are the same for all commands.\n"]
    heading = ""
    for name, command in commands(root, "sightline"):
        if name.count(" ") == 1 and (here := COMMANDS[name.split()[1]].heading) != heading:
            heading = here
            parts.append(f"## {heading}\n")
        text = inspect.cleandoc(command.help or "").replace("\b", "").replace("\f", "")
        parts.append(f"{'###' if name.count(' ') == 1 else '####'} `{name}`\n")
        context = click.Context(command, info_name=name)
        usage = " ".join(command.collect_usage_pieces(context))
        parts.append(f"```text\n{name} {usage}\n```\n")
        parts.append(text + "\n")
        if command.epilog:
            parts.append(f"```text\n{inspect.cleandoc(command.epilog).replace(chr(8), '').strip()}\n```\n")
        if rows := list(option_rows(command)):
            parts.append("\n".join(["| option | default | meaning |", "|---|---|---|", *rows]) + "\n")
    return "\n".join(parts)


def exit_codes_page() -> str:
    """Return the page of exit codes."""
    rows = [f"| {code} | {meaning} |" for code, meaning in EXIT_CODES.items()]
    return "\n".join([NOTE, "# Exit codes", "",
                      "Each `sightline` command ends with one of these codes. An error is one line on the standard "
                      "error output: what is wrong, where, and how to fix it.", "",
                      "| code | meaning |", "|---|---|", *rows, "",
                      "`SIGHTLINE_DEBUG=1` shows the traceback of an unexpected error.", ""])


def rejections_page() -> str:
    """Return the page of reasons for which a robot rejects a message."""
    rows = [f"| `{reason}` | {' | '.join(REMEDIES[reason])} |" for reason in RejectReason]
    return "\n".join([NOTE, "# Rejections", "",
                      "A robot counts each message that it rejects under one of these reasons. `sightline status` "
                      "shows the counts. The names are part of the [protocol](protocol.md).", "",
                      "| reason | meaning | what to do |", "|---|---|---|", *rows, "",
                      f"The robot counts `{CLAMPED}` next to these reasons: it accepted the command and reduced it to "
                      "its limits.", ""])


def setting_rows(config: Config, prefix: str = "") -> Iterator[str]:
    """Yield one table row per key of a configuration: key, default, allowed values, meaning."""
    properties = type(config).model_json_schema()["properties"]
    meanings = attribute_docstrings(type(config))
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if isinstance(value, Config):
            yield from setting_rows(value, f"{prefix}{name}.")
            continue
        schema: Bounds = properties.get(field.alias or name, {})
        allowed = " ".join(f"{word} {schema[bound]:g}" for bound, word in WORDS.items() if bound in schema)
        meaning = meanings.get(name) or schema.get("description", "")
        yield f"| `{prefix}{name}` | `{cell(_plain(value))}` | {allowed} | {cell(meaning)} |"


def attribute_docstrings(model: type[Config]) -> dict[str, str]:
    """Return the first paragraph of the docstring below each field of a model and of its bases."""
    found: dict[str, str] = {}
    for one in reversed([base for base in model.__mro__ if issubclass(base, Config) and base is not Config]):
        [definition] = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        assert isinstance(definition, ast.ClassDef)
        for field, text in itertools.pairwise(definition.body):
            if (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr)
                    and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)):
                paragraph = inspect.cleandoc(text.value.value).partition("\n\n")[0]
                found[field.target.id] = paragraph.replace("\n", " ").removesuffix(".")
    return found


def _plain(value: Any) -> str:
    """Return a default in the notation of a configuration file."""
    if hasattr(value, "model_dump"):
        value = value.model_dump(mode="json", exclude_unset=True)
    if isinstance(value, list | tuple) and value and hasattr(value[0], "model_dump"):
        value = [one.model_dump(mode="json") for one in value]
    text = "not set" if value is None else json.dumps(value, default=str, ensure_ascii=False)
    return text.replace(f"sightline-sim-{os.getuid()}", "sightline-sim-UID")  # the page is the same for every user


def settings_page() -> str:
    """Return the page of every configuration key of each service."""
    parts = [NOTE, "# Settings\n",
             "This page lists each key of each service. [Configuration](configuration.md) explains where a value comes "
             "from. Plug-ins have their own options below `options`; `sightline config check` validates them too.\n"]
    for service in SERVICES:
        rows = ["| key | default | allowed | meaning |", "|---|---|---|---|", *setting_rows(model_of(service)())]
        parts.append(f"## `{service}`\n\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def detector_card_page() -> str:
    """Return the model card of the shipped detector, for the site."""
    card = (ROOT / "vision_side" / "models" / "sightline.md").read_text("utf-8")
    return NOTE + re.sub(r"\]\((?![a-z]+:|#)[^)]*/docs/", "](../../", card)


PAGES: Final[Mapping[str, Callable[[], str]]] = {
    "cli.md": cli_page,
    "exit-codes.md": exit_codes_page,
    "rejections.md": rejections_page,
    "settings.md": settings_page,
    "results/detector-card.md": detector_card_page,
}


def figures(language: str) -> str:
    """Return the table of the README: the faults, the figure of eight, the slow detector."""
    results = REFERENCE / "results"
    faults = json.loads((results / "faults.json").read_text("utf-8"))
    passed, total = sum(row["ok"] for row in faults["rows"]), len(faults["rows"])
    stop_s = max(check["value"] for check in faults["checks"] if check["name"].endswith(": zero")) / 1e3
    stop_m = max(check["value"] for check in faults["checks"] if check["name"].endswith(": distance"))
    page = (results / "performance.md").read_text("utf-8")
    eight_deg = float(re.search(r"\| eight \+50 ms 10% loss: bearing_rms_deg \| [\d.]+ \| ([\d.]+) \|", page)[1])
    slow = page.partition("## A detector of 80 ms")[2].partition("\n## ")[0]
    # After the name: answered in percent, images per second, median age.
    ours_ms, callback_ms = (float(re.search(rf"\| {name} \| [\d.]+ \| [\d.]+ \| ([\d.]+) \|", slow)[1])
                            for name in ("sightline", "callback"))
    stop_s, stop_m, eight_deg = (math.ceil(worst * 100) / 100 for worst in (stop_s, stop_m, eight_deg))
    return README_TABLES[language].format(
        passed=passed, total=total, stop_s=stop_s, stop_m=stop_m, eight_deg=eight_deg, ours_ms=ours_ms,
        callback_s=callback_ms / 1e3)


def _keys() -> str:
    """Return the keys of each layout, as teleop shows them."""
    parts = [f"With `--keys {name}`:\n\n```text\n{layout.help.rstrip()}\n```\n" for name, layout in LAYOUTS.items()]
    return "\n".join(parts)


BLOCKS: Final[Mapping[str, tuple[str, Callable[[], str]]]] = {
    "README.md": ("figures", lambda: figures("en")),
    "README.zh-CN.md": ("figures", lambda: figures("zh")),
    "docs/how-to/teleop.md": ("keys", _keys),
}
"""Handwritten pages with one generated block: the page, the name of its block, and its text."""


def _files(root: Path) -> Iterator[tuple[Path, str]]:
    """Yield each generated file with its text."""
    for name, page in PAGES.items():
        yield root / "docs" / "reference" / name, page()
    for name, (block, text) in BLOCKS.items():
        marks = re.compile(rf"(<!-- generated: {block}[^\n]*-->\n).*?(<!-- /generated -->)", re.DOTALL)
        path = root / name
        if path.exists():
            new = text()
            yield path, marks.sub(lambda found, new=new: found[1] + new + found[2], path.read_text("utf-8"))


def stale(root: Path = ROOT) -> list[str]:
    """Return the files below `root` that differ from the code."""
    return [str(path.relative_to(root)) for path, text in _files(root)
            if not path.exists() or path.read_text("utf-8") != text]


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    """Write the files below `root`, or check them."""
    if "--check" in arguments:
        for name in (old := stale(root)):
            print(f"{name} is not current; run `python -m docs.make.reference`")
        return CHECK_FAILED if old else 0
    for path, text in _files(root):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
