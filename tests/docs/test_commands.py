"""Every `sightline` command that a page shows exists, with each of its options."""

import re
from functools import cache

import pytest
from typer.main import get_command

from sightline.operator_side.cli.commands import app
from tests.docs.test_pages import FENCE, PAGES, SHELL, TOP, shown

INLINE = re.compile(r"`([^`\n]+)`")
COMMAND = re.compile(r"(?<![\w./=-])(?:[\w./]+/)?sightline +([a-z-][^|;&)#`\n>]*)")


def commands_in(text: str):
    """Yield the words after `sightline` of each command in the shell blocks and in the backticks of a page."""
    code = [body for language, body in FENCE.findall(text) if language.strip() in SHELL]
    code += [f"{one}\n" for one in INLINE.findall(FENCE.sub("", text))]
    for match in COMMAND.finditer("\n".join(code).replace("\\\n", " ")):
        yield match[1].split()


@cache
def root():
    return get_command(app)


def options_of(command) -> dict[str, bool]:
    """Return each option of a command, and whether a value follows it."""
    return dict.fromkeys(("--help", "--version"), False) | {
        name: not getattr(parameter, "is_flag", False)
        for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)
    }


def problem_with(words: list[str]) -> str:
    """Return why the command line has no such command or option; empty if it has."""
    command, path, is_value = root(), ["sightline"], False
    for word in words:
        subcommands = getattr(command, "commands", {})
        if is_value:
            is_value = False
        elif word == "--":
            break
        elif word.startswith("--"):
            options, (name, equals, _) = options_of(command), word.partition("=")
            if name not in options:
                return f"{' '.join(path)} has no option {name}"
            is_value = options[name] and not equals
        elif subcommands and re.fullmatch(r"[a-z-]+", word):
            if word not in subcommands:
                return f"{' '.join(path)} has no command {word}"
            command = subcommands[word]
            path.append(word)
    return ""


def test_every_command_of_every_page_exists_with_its_options():
    found = [(page, words) for page in (*TOP, *PAGES) for words in commands_in(page.read_text("utf-8"))]
    assert len(found) > 300 and sum(any("--" in word for word in words) for _, words in found) > 100
    assert sorted({f"{shown(page)}: {why}" for page, words in found if (why := problem_with(words))}) == []


@pytest.mark.parametrize(("words", "why"), [
    ("vision --connect tcp/x:1 --weigth 2", "sightline vision has no option --weigth"),
    ("robot --share", "sightline robot has no option --share"),
    ("install vision --instances=3 --yes --now", "sightline install has no option --now"),
    ("visoin", "sightline has no command visoin"), ("config chekc robot", "sightline config has no command chekc"),
    ("score --scenario circle --jobs", ""), ("conform codec -- node --x", ""), ("config check robot --help", ""),
    ("vision --share --name a --weight=2 --robot 'r*'", ""),
])  # fmt: skip
def test_command_that_does_not_exist_is_found(words, why):
    assert problem_with(words.split()) == why
    page = f"Text.\n\n```sh\nsudo .venv/bin/sightline {words} \\\n  --help | head\ncd sightline && ls\n```\n"
    assert list(commands_in(page)) == [[*words.split(), "--help"]]
