"""The contract: what is on the wire, and the ways to carry it. Imports nothing of ours."""

from typing import Final

VERSION: Final = 1
"""Wire protocol version; the `v` of every header."""
