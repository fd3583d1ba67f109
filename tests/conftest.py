"""A shell that starts the tests in its background has Ctrl-C ignored, and every child would inherit that."""

import signal

signal.signal(signal.SIGINT, signal.default_int_handler)
