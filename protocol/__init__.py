"""The wire contract: channels, messages, codecs and the transports that carry them. Imports nothing of ours."""

from typing import Final

VERSION: Final = 1
"""Wire protocol version; the `v` of every header."""
