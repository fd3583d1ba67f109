"""`zero` of a drive, found by what a robot noted at its start, for when no process of the robot is left. Shell.

    python -P -m sightline.robot_side.guardian.zero sightline robot --config robot.toml --zero-motors

The motors of a dead robot still turn while a configuration is read, so this needs none, and no third-party package but
those of the drive. Without a note, or if its `zero` fails, it becomes the command that its arguments name.
"""

import importlib
import json
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Final

_NOTE: Final = "sightline-zero.json"


def load_zero(named: Mapping[str, Any]) -> Callable[[Mapping[str, Any]], None]:
    """Import `zero` of a drive, `module` and `name`, and prepare it."""
    try:
        module = importlib.import_module(named["module"])
    except ImportError:  # of a plug-in that is installed in an unusual way
        importlib.import_module("site").main()
        module = importlib.import_module(named["module"])
    getattr(module, "prepare", lambda: None)()
    zero: Any = module
    for part in named["name"].split("."):
        zero = getattr(zero, part)
    return zero  # type: ignore[no-any-return]


def write_note(setup: Mapping[str, Any]) -> None:
    """Store the drive of this start for `main`, if systemd runs this process. It keeps the folder until the last stop.

    Raises:
        OSError: it cannot be written.
    """
    if path := _note_path():
        with open(path, "w", encoding="utf-8") as file:  # noqa: PTH123  this process needs no pathlib
            json.dump({"path": setup["path"], "zero": setup["zero"]}, file)


def _note_path() -> str:
    folder = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return folder and f"{folder}/{_NOTE}"


def main(arguments: list[str]) -> None:
    """Set the motors of the note to zero, or become the command `arguments`."""
    # Whatever is wrong with a note or a drive, the command reports it.
    with suppress(BaseException):
        with open(_note_path(), encoding="utf-8") as file:  # noqa: PTH123
            note = json.load(file)
        sys.path[:] = note["path"]
        load_zero(note["zero"])(note["zero"]["config"])
        return
    os.execv(arguments[0], arguments)


if __name__ == "__main__":
    main(sys.argv[1:])
