"""The wire contract: channels, messages, codecs and the transports that carry them.

May import: no other package of Sightline.
Interface: `channels`, `messages` and `codec` for data on the network; `transports.open.open_link` for a `Link`.
"""

from typing import Final

VERSION: Final = 1
"""Wire protocol version; the `v` of every header."""
NAME_PATTERN: Final = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}"
"""Pattern of a robot id, and of the name of a vision service."""
ROLE_PATTERN: Final = r"[a-z][a-z0-9_]{0,15}"
"""Pattern of a `source`."""
