"""The command line, one file per group of commands. It composes every other package.

May import: every package; nothing imports this folder.
Interface: `main` is the command `sightline`.
"""

import sys


def main() -> None:
    """Run the command of this process. Ctrl-C during the imports ends it like a later Ctrl-C."""
    try:
        from sightline.operator_side.cli import app
    except KeyboardInterrupt:
        sys.exit(130)  # `app.INTERRUPTED`
    app.main()
