"""The command line, one file per group of commands. It composes every other package.

May import: every package; nothing imports this folder.
Interface: `main` is the command `sightline`.
"""

import sys


def main() -> None:
    """Run the command of this process. Ctrl-C while its modules are imported ends it as Ctrl-C does later."""
    try:
        from sightline.operator_side.cli import app
    except KeyboardInterrupt:
        sys.exit(130)  # `app.INTERRUPTED`
    app.main()
