"""A `sightline` command in a real pseudo-terminal of its own session, as a person has it."""

import os
import pty
import subprocess
import sys
from contextlib import suppress

from tests.link_rigs import until

_RUN = """
import fcntl, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)  # so that its Ctrl-C and its hang-up are signals
from sightline.operator_side.cli.app import main
main()
"""


class Terminal:
    """A `sightline` command in a pseudo-terminal of its own session."""

    def __init__(self, *arguments):
        self.master, terminal = pty.openpty()
        command = [sys.executable, "-c", _RUN, *arguments]
        self.process = subprocess.Popen(
            command, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True
        )
        os.close(terminal)
        os.set_blocking(self.master, False)
        self._text = ""

    def shows(self, text, seconds=15):
        """Wait until it has printed `text`."""
        return until(lambda: text in self.text(), seconds)

    def text(self):
        with suppress(OSError):
            self._text += os.read(self.master, 65536).decode("utf-8", "replace")
        return self._text

    def types(self, text):
        os.write(self.master, text.encode())

    def close(self):
        self.process.kill()
        self.process.wait(5)
        os.close(self.master)
