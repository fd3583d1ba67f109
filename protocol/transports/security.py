"""Certificates, tokens and access rules: which role may publish and subscribe to what. Shell (reads files).

A role is the common name of a certificate. Zenoh judges by inclusion and at every hop, and says nothing to who is
denied: whoever listens denies all that is not listed here.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sightline.protocol.channels import (
    CHANNELS,
    KEY_PREFIX,
    MAX_HEADER_BYTES,
    REQUEST,
    SOURCES_OF_ROLE,
    Channel,
    Direction,
)
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.endpoints import WebSocketEndpoint, parse_zenoh_endpoint, with_allowed

ROBOT_ROLE: Final = "robot"
ROLES: Final = (ROBOT_ROLE, *SOURCES_OF_ROLE)
PRESENCE_PREFIX: Final = "sightline-presence"
"""Where peers say that they are there (`transports/zenoh/presence.py`): beside `sightline/`, the keys of channels."""
_TLS: Final = ("tls", "quic")


def certificate_role(source: str) -> str:
    """The certificate that a link of role `source` shows; who is none of these is a viewer."""
    if source == ROBOT_ROLE:
        return ROBOT_ROLE
    return next((role for role, sources in SOURCES_OF_ROLE.items() if source in sources), "viewer")


@dataclass(frozen=True)
class RoleKeys:
    """Keys of one role in a folder that `sightline keys` made."""

    folder: str
    role: str

    def check(self, endpoints: Sequence[str]) -> None:
        """Raise ConfigError if an endpoint is not of TLS: there is no silent way back to a plain link."""
        for endpoint in endpoints:
            if parse_zenoh_endpoint(endpoint)[0] not in _TLS:
                raise ConfigError(f"{endpoint} is not secured: with --secure write tls/<host>:<port> or quic/...")

    def tls_section(self) -> dict[str, Any]:
        """Zenoh's `transport/link/tls`: both ends show a certificate of one private authority, names are verified."""
        key, certificate = f"{self.folder}/{self.role}.key", f"{self.folder}/{self.role}.pem"
        return {
            "root_ca_certificate": f"{self.folder}/ca.pem",
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "listen_private_key": key,
            "listen_certificate": certificate,
            "connect_private_key": key,
            "connect_certificate": certificate,
        }

    def access_section(self) -> dict[str, Any]:
        """Zenoh's `access_control`: what passes is only what a listed role may say or hear, at every hop."""
        rules = {role: list(_rules(role)) for role in ROLES}
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": [rule for of_role in rules.values() for rule in of_role],
            "subjects": [{"id": role, "cert_common_names": [role]} for role in ROLES],
            "policies": [{"subjects": [role], "rules": [rule["id"] for rule in rules[role]]} for role in ROLES],
        }


def size_limit_section() -> list[dict[str, Any]]:
    """Zenoh's `low_pass_filter`: what is over its channel's bound ends at whoever listens, and crosses no radio."""
    return [
        {"id": f"size of {channel.name}", "flows": ["ingress"], "messages": ["put"], "key_exprs": [_pattern(channel)],
         "size_limit": MAX_HEADER_BYTES + channel.max_payload_bytes}
        for channel in CHANNELS.values()
    ]


def load_role_keys(folder: str, source: str) -> RoleKeys | None:
    """What a link of role `source` shows and checks; None for no folder. Raises ConfigError for a missing file."""
    if not folder:
        return None
    role, folder = certificate_role(source), str(Path(folder).expanduser())
    missing = [name for name in ("ca.pem", f"{role}.pem", f"{role}.key") if not (Path(folder) / name).is_file()]
    if missing:
        raise ConfigError(f"{missing[0]} is missing in {folder}: make keys with `sightline keys init`, and copy "
                          f"ca.pem, {role}.pem and {role}.key to this machine")
    return RoleKeys(folder, role)


def may_publish(role: str) -> list[str]:
    """Key expressions, for any robot, that a certificate of `role` may publish on."""
    return [key for channel in CHANNELS.values() for key in _published(role, channel)]


def may_subscribe(role: str) -> list[str]:
    """Key expressions, for any robot, that a certificate of `role` may subscribe to."""
    own = Direction.TO_ROBOT if role == ROBOT_ROLE else Direction.FROM_ROBOT
    heard = [one for one in CHANNELS.values() if one.direction is own or (one.passed_on and role != ROBOT_ROLE)]
    return [_pattern(channel) for channel in heard]


def _published(role: str, channel: Channel) -> list[str]:
    if role == ROBOT_ROLE:
        return [_pattern(channel)] if channel.direction is Direction.FROM_ROBOT else []
    if channel.direction is Direction.FROM_ROBOT or (channel is REQUEST and role != "operator"):
        return []
    sources = [source for source in SOURCES_OF_ROLE[role] if not channel.said_by or source in channel.said_by]
    return [f"{KEY_PREFIX}/*/{channel.name}/{source}" for source in sources]


def _pattern(channel: Channel) -> str:
    return f"{KEY_PREFIX}/*/{channel.name}" + ("/*" if channel.has_source else "")


def _rules(role: str) -> list[dict[str, Any]]:
    """What comes in from a peer of `role` and goes out to it; subscriptions go out so that it knows who listens."""
    said, heard = may_publish(role), may_subscribe(role)
    listeners = sorted({_pattern(CHANNELS[key.split("/")[2]]) for key in said})
    rows = [
        ("says", "ingress", ["put"], said),
        ("subscribes", "ingress", ["declare_subscriber"], heard),
        ("hears", "egress", ["put"], heard),
        ("is heard", "egress", ["declare_subscriber"], listeners),
        *_presence_rows(role),
    ]
    return [
        {"id": f"{role} {what}", "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
        for what, flow, messages, keys in rows
        if keys
    ]


def _presence_rows(role: str) -> list[tuple[str, str, list[str], list[str]]]:
    """Everybody may ask who is there; each answers as its own role only."""
    own, all_of_it = [f"{PRESENCE_PREFIX}/{role}/*"], [f"{PRESENCE_PREFIX}/**"]
    return [
        ("answers", "ingress", ["declare_queryable", "reply"], own),
        ("is asked", "egress", ["query"], all_of_it),
        ("asks", "ingress", ["query"], all_of_it),
        ("is answered", "egress", ["declare_queryable", "reply"], all_of_it),
    ]


# The tokens of roles in a `--secure` folder, one file each: `vision.token`, `operator.token` ... Shell (reads files).
#
# Who shows the text of one comes in as that role.


_TOKEN: Final = re.compile(r"[A-Za-z0-9_-]{16,128}")


def read_tokens(folder: str) -> Mapping[str, str]:
    """Token -> role, of every token file in `folder`; none without a folder. Raises ConfigError for a bad one."""
    if not folder:
        return {}
    files = {role: Path(folder).expanduser() / f"{role}.token" for role in ROLES}
    tokens = {_read(file): role for role, file in files.items() if file.is_file()}
    if len(tokens) < sum(file.is_file() for file in files.values()):
        raise ConfigError(f"{folder} holds one token for two roles; give each its own")
    return tokens


def own_token(folder: str, source: str) -> str:
    """What a link of role `source` shows when it connects; "" if it has none."""
    file = Path(folder).expanduser() / f"{certificate_role(source)}.token"
    return _read(file) if folder and file.is_file() else ""


def _read(file: Path) -> str:
    try:
        token = file.read_text("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file} cannot be read: {error}") from None
    if not _TOKEN.fullmatch(token):
        raise ConfigError(f"{file} holds no token: 16 to 128 letters, digits, '_' or '-'; try `openssl rand -hex 16`")
    return token


# Who may come in at a WebSocket endpoint, and as what: by token, or in the older dialect by address. Pure.


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
