"""What a viewer says to a frame: seen. It returns credit and drives nothing. Shell (publishes)."""

import secrets

from sightline.protocol.channels import ACK
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.security import SOURCES_OF_ROLE, certificate_role


class Viewer:
    """One viewer's session; `role` names it on the wire. Keys in `secure` may be of a role that has nothing to say."""

    def __init__(self, link: Link, role: str, secure: str = "") -> None:
        self._link, self._role = link, role
        self._is_silent = bool(secure) and not SOURCES_OF_ROLE.get(certificate_role(role))
        self._session = secrets.token_hex(4)
        self._seq = 0

    def acknowledge(self, message: Message) -> bool:
        """Answer one frame, where that is allowed; False for what is none."""
        try:
            frame = decode(FrameHeader, message.header)
        except WireError:
            return False
        if self._is_silent:
            return True
        echo = Echo(channel="frame", session=frame.session, seq=frame.seq, t_us=frame.t_us)
        header = AnswerHeader(source=self._role, session=self._session, seq=self._seq, echo=echo)
        self._seq += 1
        self._link.publish(ACK, encode(header), b"")
        return True
