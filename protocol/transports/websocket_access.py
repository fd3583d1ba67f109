"""Who may come in at a WebSocket endpoint, and as what: by token, or in the older dialect by address. Pure."""

import hmac
import ipaddress
from collections.abc import Mapping, Sequence
from typing import Final

from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.security import may_publish
from sightline.protocol.transports.websocket_endpoints import WebSocketEndpoint, with_allowed

NOT_LISTED: Final = "NOT_LISTED"
"""Counted for a client of the older dialect from an address that its owner did not list."""
NO_TOKEN: Final = "NO_TOKEN"
"""Counted for a client that showed no token, or none of ours."""

_BEARER: Final = "bearer "
_ENTRY: Final = "sightline.token."


def check_listening(endpoint: WebSocketEndpoint, tokens: Mapping[str, str]) -> None:
    """Raise ConfigError for an endpoint that would let anybody in from beyond this machine."""
    if endpoint.is_loopback:
        return
    if endpoint.legacy is None and not tokens:
        raise ConfigError(
            f"{endpoint.text} listens beyond this machine, where anybody could drive: give --secure DIR with a token "
            "for each role (DIR/vision.token ...), or listen on 127.0.0.1"
        )
    if endpoint.legacy is not None and not endpoint.allow_from:
        option = with_allowed(endpoint.text, ["192.168.1.7"])
        raise ConfigError(
            f"{endpoint.text} listens beyond this machine to clients that carry no token: list who may come in, "
            f'legacy.allow_from = ["192.168.1.7"] or {option}'
        )


def client_address_problem(address: str, allow_from: Sequence[str]) -> str:
    """Why a client at `address` may not come in; "" if it may. An empty list allows every address that gets here."""
    here = ipaddress.ip_address(address.partition("%")[0])
    here = getattr(here, "ipv4_mapped", None) or here
    if not allow_from or any(here in ipaddress.ip_network(network) for network in allow_from):
        return ""
    return f"{address} is not listed in legacy.allow_from: the robot's owner lists who may come in here"


def role_of_token(tokens: Mapping[str, str], authorizations: Sequence[str], offers: Sequence[str]) -> str | None:
    """The role of who sent these `Authorization` and `Sec-WebSocket-Protocol` headers; None without a token of ours.

    Every token is compared, and in constant time, so that no clock tells how much of a guess was right.
    """
    shown = [text[len(_BEARER) :].strip() for text in authorizations if text.lower().startswith(_BEARER)]
    entries = [entry.strip() for offer in offers for entry in offer.split(",")]
    shown += [entry[len(_ENTRY) :] for entry in entries if entry.startswith(_ENTRY)]
    if len(shown) != 1:
        return None
    matches = [role for token, role in tokens.items() if hmac.compare_digest(token.encode(), shown[0].encode())]
    return matches[0] if matches else None


def bearer_header(token: str) -> str:
    """The `Authorization` header that shows `token`."""
    return f"Bearer {token}"


def grants_of_role(role: str) -> frozenset[tuple[str, ...]]:
    """(channel, source) of all that `role` may publish; from a robot just (channel,)."""
    return frozenset(tuple(key.replace("/*/", "/", 1).split("/")[1:]) for key in may_publish(role))
