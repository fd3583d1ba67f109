"""The wire contract: channels, messages, codecs and the transports that carry them.

May import: no other package of Sightline.
Interface: `channels`, `messages` and `codec` for what crosses the network; `transports.open.open_link` for a `Link`.
"""

from typing import Final

VERSION: Final = 1
"""Wire protocol version; the `v` of every header."""
