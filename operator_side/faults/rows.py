"""All rows of the fault bench, and the choice among them. Shell (what the rows inject is)."""

from collections.abc import Sequence
from typing import Final

from operator_side.faults import rows_commands, rows_crowd, rows_network, rows_people, rows_processes
from operator_side.faults.row import Row
from operator_side.settings_errors import no_such_name
from protocol.errors import ConfigError

ROWS: Final[tuple[Row, ...]] = (
    *rows_processes.ROWS, *rows_network.ROWS, *rows_commands.ROWS, *rows_crowd.ROWS, *rows_people.ROWS,
)


def chosen(only: Sequence[str], *, short: bool) -> list[Row]:
    """The rows named by id or by what comes before the dot; all without names. Raises ConfigError for no such row."""
    for name in only:
        if not any(_is_named(row, name) for row in ROWS):
            raise ConfigError(no_such_name("fault", name, [row.id for row in ROWS]))
    return [
        row for row in ROWS
        if (not only or any(_is_named(row, name) for name in only)) and (row.short or not short)
    ]


def _is_named(row: Row, name: str) -> bool:
    return name in (row.id, row.id.partition(".")[0])
