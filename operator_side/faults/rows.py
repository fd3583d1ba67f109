"""All rows of the fault bench, and the choice among them. Shell (what the rows inject is)."""

from collections.abc import Sequence
from typing import Final

from sightline.operator_side.faults import rows_commands, rows_crowd, rows_network, rows_people
from sightline.evaluation.faults import cases as rows_processes
from sightline.evaluation.faults.runner import Case
from sightline.operator_side.settings_errors import no_such_name
from sightline.protocol.errors import ConfigError

CASES: Final[tuple[Case, ...]] = (
    *rows_processes.PROCESS_CASES, *rows_network.NETWORK_CASES, *rows_commands.COMMAND_CASES, *rows_crowd.CLIENT_CASES, *rows_people.OPERATOR_CASES,
)


def chosen(only: Sequence[str], *, short: bool) -> list[Case]:
    """The rows named by id or by what comes before the dot; all without names. Raises ConfigError for no such row."""
    for name in only:
        if not any(_is_named(row, name) for row in CASES):
            raise ConfigError(no_such_name("fault", name, [row.id for row in CASES]))
    return [
        row for row in CASES
        if (not only or any(_is_named(row, name) for name in only)) and (row.short or not short)
    ]


def _is_named(row: Case, name: str) -> bool:
    return name in (row.id, row.id.partition(".")[0])
