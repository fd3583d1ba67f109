"""Define certificates, tokens and access rules: the channels that each role may use. Shell (reads files).

A role is the common name of a certificate. Zenoh applies access rules by inclusion and at every hop, without a report
to the denied peer. The listening end denies everything that is not listed here.
"""

from __future__ import annotations

import datetime
import hmac
import ipaddress
import re
from binascii import a2b_base64
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
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
from sightline.protocol.errors import ConfigError, home_path
from sightline.protocol.transports.endpoints import WebSocketEndpoint, parse_zenoh_endpoint, with_allowed
from sightline.protocol.transports.tokens import ALL_TOKENS, DETECTOR_KIND, DRIVER_KIND, ROBOT_KIND, VISION_KIND
from sightline.protocol.transports.tokens import PREFIX as TOKEN_PREFIX

ROBOT_ROLE: Final = "robot"
ROLES: Final = (ROBOT_ROLE, *SOURCES_OF_ROLE)
# A router forwards the messages of all roles to another router. It has no token, because WebSocket has no routers.
ROUTER_ROLE: Final = "router"
CERTIFICATES: Final = (*ROLES, ROUTER_ROLE)
# Prefix of presence keys (`transports/zenoh/presence.py`), next to `sightline/`, the prefix of channels.
PRESENCE_PREFIX: Final = "sightline-presence"
_TLS: Final = ("tls", "quic")


def certificate_role(source: str) -> str:
    """Return the certificate for a link with role `source`. An unknown role uses the certificate of a viewer."""
    if source in (ROBOT_ROLE, ROUTER_ROLE):
        return source
    return next((role for role, sources in SOURCES_OF_ROLE.items() if source in sources), "viewer")


@dataclass(frozen=True)
class RoleKeys:
    """The keys of one role in a folder from `sightline keys`."""

    folder: str
    role: str

    def check(self, endpoints: Sequence[str]) -> None:
        """Raise ConfigError for an endpoint without TLS, so that no link is silently unencrypted."""
        for endpoint in endpoints:
            if parse_zenoh_endpoint(endpoint)[0] not in _TLS:
                raise ConfigError(f"{endpoint} has no TLS: with --secure use tls/<host>:<port> or quic/...")

    def tls_section(self) -> dict[str, Any]:
        """Return Zenoh's `transport/link/tls`. Both ends have a certificate of one private authority."""
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
        """Return Zenoh's `access_control`: each role may publish and receive only its own channels, at every hop."""
        rules = {**{role: list(_rules(role)) for role in ROLES}, ROUTER_ROLE: _ROUTER_RULES}
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": [rule for of_role in rules.values() for rule in of_role],
            "subjects": [{"id": role, "cert_common_names": [role]} for role in rules],
            "policies": [{"subjects": [role], "rules": [rule["id"] for rule in rules[role]]} for role in rules],
        }


def check_keys(keys: RoleKeys | None, endpoints: Sequence[str]) -> None:
    """Raise ConfigError for an endpoint that does not fit the keys of its link, or their absence."""
    if keys is not None:
        keys.check(endpoints)
        return
    for endpoint in endpoints:
        if (kind := parse_zenoh_endpoint(endpoint)[0]) in _TLS:
            raise ConfigError(f"{endpoint}: a {kind}/ endpoint needs keys; pass --secure DIR")


def size_limit_section() -> list[dict[str, Any]]:
    """Return Zenoh's `low_pass_filter`, so that the listening end drops a message above the limit of its channel."""
    return [
        {"id": f"size of {channel.name}", "flows": ["ingress"], "messages": ["put"], "key_exprs": [_pattern(channel)],
         "size_limit": MAX_HEADER_BYTES + channel.max_payload_bytes}
        for channel in CHANNELS.values()
    ]


_ROUTER_RULES: Final = [{
    "id": "router passes on", "permission": "allow", "flows": ["ingress", "egress"],
    "messages": ["put", "declare_subscriber", "query", "declare_queryable", "reply", "liveliness_token",
                 "liveliness_query", "declare_liveliness_subscriber"],
    "key_exprs": [f"{KEY_PREFIX}/**", f"{PRESENCE_PREFIX}/**", ALL_TOKENS],
}]
"""Each of two linked routers has already checked the role of a message's sender."""


def load_role_keys(folder: str, source: str) -> RoleKeys | None:
    """Load the keys of a link.

    Args:
        folder: folder from `sightline keys`, or "".
        source: role of the link.

    Returns:
        The keys, or None without a folder.

    Raises:
        ConfigError: a file is missing.
    """
    if not folder:
        return None
    role, folder = certificate_role(source), str(home_path(folder))
    missing = [name for name in ("ca.pem", f"{role}.pem", f"{role}.key") if not (Path(folder) / name).is_file()]
    if missing:
        raise ConfigError(f"{missing[0]} is missing in {folder}: create keys with `sightline keys init` or "
                          f"`keys add KEYS {role}`, and copy ca.pem, {role}.pem and {role}.key to this machine")
    return RoleKeys(folder, role)


def may_publish(role: str) -> list[str]:
    """List the key expressions, for any robot, on which a certificate of `role` may publish."""
    return [key for channel in CHANNELS.values() for key in _published(role, channel)]


def may_subscribe(role: str) -> list[str]:
    """List the key expressions, for any robot, to which a certificate of `role` may subscribe."""
    own = Direction.TO_ROBOT if role == ROBOT_ROLE else Direction.FROM_ROBOT
    received = [one for one in CHANNELS.values() if one.direction is own or (one.passed_on and role != ROBOT_ROLE)]
    return [_pattern(channel) for channel in received]


def _published(role: str, channel: Channel) -> list[str]:
    if role == ROBOT_ROLE:
        return [_pattern(channel)] if channel.direction is Direction.FROM_ROBOT else []
    if channel.direction is Direction.FROM_ROBOT or (channel is REQUEST and role != "operator"):
        return []
    sources = [source for source in SOURCES_OF_ROLE[role] if not channel.published_by or source in channel.published_by]
    return [f"{KEY_PREFIX}/*/{channel.name}/{source}" for source in sources]


def _pattern(channel: Channel) -> str:
    return f"{KEY_PREFIX}/*/{channel.name}" + ("/*" if channel.has_source else "")


def _rules(role: str) -> list[dict[str, Any]]:
    """Return the access rules for a peer of `role`, in both directions."""
    published, received = may_publish(role), may_subscribe(role)
    # A publisher must see subscriptions. Otherwise `has_listener` is False, and it publishes nothing.
    listeners = sorted({_pattern(CHANNELS[key.split("/")[2]]) for key in published})
    rows = [
        ("publishes", "ingress", ["put"], published),
        ("subscribes", "ingress", ["declare_subscriber"], received),
        ("receives", "egress", ["put"], received),
        ("is received", "egress", ["declare_subscriber"], listeners),
        *_presence_rows(role),
        *_token_rows(role),
    ]
    return [
        {"id": f"{role} {what}", "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
        for what, flow, messages, keys in rows
        if keys
    ]


def _presence_rows(role: str) -> list[tuple[str, str, list[str], list[str]]]:
    """Return the presence rules. Each role may query all peers, and reply only as itself."""
    own, all_of_it = [f"{PRESENCE_PREFIX}/{role}/*"], [f"{PRESENCE_PREFIX}/**"]
    return [
        ("replies", "ingress", ["declare_queryable", "reply"], own),
        ("is queried", "egress", ["query"], all_of_it),
        ("queries", "ingress", ["query"], all_of_it),
        ("receives replies", "egress", ["declare_queryable", "reply"], all_of_it),
    ]


def _token_rows(role: str) -> list[tuple[str, str, list[str], list[str]]]:
    """Return the rules of liveliness tokens. All roles may see them, and three roles declare their own kinds."""
    kinds = {ROBOT_ROLE: [ROBOT_KIND], "vision": [VISION_KIND, DRIVER_KIND], "detector": [DETECTOR_KIND]}
    own = kinds.get(role, [])
    return [
        ("is alive", "ingress", ["liveliness_token"], [f"{TOKEN_PREFIX}/{kind}/**" for kind in own]),
        ("watches", "ingress", ["liveliness_query", "declare_liveliness_subscriber"], [ALL_TOKENS]),
        ("sees", "egress", ["liveliness_token"], [ALL_TOKENS]),
        ("is watched", "egress", ["liveliness_query", "declare_liveliness_subscriber"], [ALL_TOKENS]),
    ]


# The dates of the certificates in a `--secure` folder. Shell (reads files). A robot does not have `cryptography`, and
# `ssl` takes 4 MB.


EXPIRES_SOON: Final = datetime.timedelta(days=30)
_SEQUENCE: Final = 0x30


def date_problem(
    folder: str, source: str, ahead: datetime.timedelta = EXPIRES_SOON, now: datetime.datetime | None = None
) -> str:
    """Return the problem with the dates of a link's certificates, or "" without a problem or a folder.

    Args:
        folder: folder from `sightline keys`, or "".
        source: role of the link.
        ahead: report a certificate that ends within this time, too.
        now: time, or None for the clock of this machine.
    """
    role, now = certificate_role(source), now or datetime.datetime.now(datetime.UTC)
    for what, name, repair in () if not folder else (
        ("the authority of the keys", "ca.pem", "create new keys with `sightline keys init`"),
        ("the certificate of this end", f"{role}.pem", f"run `sightline keys add DIR {role}` where ca.key is"),
    ):
        # The link itself reports a missing or damaged file.
        with suppress(OSError, ValueError, IndexError):
            begins, ends = validity((home_path(folder) / name).read_text("ascii"))
            if now < begins:
                return (f"{what} is not valid before {begins:%Y-%m-%d} ({name}); set the clock of this machine (now "
                        f"{now:%Y-%m-%d %H:%M} UTC)")
            if ends < now + ahead:
                how = "has expired" if ends < now else "ends soon"
                return f"{what} {how} ({name}, {ends:%Y-%m-%d}); {repair}, and copy the new files to this machine"
    return ""


def validity(pem: str) -> tuple[datetime.datetime, datetime.datetime]:
    """Return the first and last moment of a certificate. Raises ValueError or IndexError for damaged text.

    Source: RFC 5280, 4.1. The validity is the third sequence, after the algorithm and the issuer.
    """
    encoded = pem.partition("-----BEGIN CERTIFICATE-----")[2].partition("-----END")[0]
    ((_, certificate),) = _elements(a2b_base64(encoded))
    (_, signed), *_ = _elements(certificate)
    begins, ends = _elements([content for tag, content in _elements(signed) if tag == _SEQUENCE][2])
    return _time(begins[1].decode()), _time(ends[1].decode())


def _elements(der: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield tag and content of each element."""
    while der:
        length, start = der[1], 2
        # A long length: the low seven bits are the number of its bytes.
        if length > 0x7F:
            start += length & 0x7F
            length = int.from_bytes(der[2:start])
        yield der[0], der[start : start + length]
        der = der[start + length :]


def _time(text: str) -> datetime.datetime:
    # The short form has a year of two digits, from 1950 to 2049.
    digits = text if len(text) > len("261130000000Z") else f"{'20' if text < '50' else '19'}{text}"
    return datetime.datetime.fromisoformat(f"{digits[:8]}T{digits[8:]}")


# The tokens of roles in a `--secure` folder, one file each: `vision.token`, `operator.token` ... Shell (reads files).
#
# A client with the text of a token connects in that role.


_TOKEN: Final = re.compile(r"[A-Za-z0-9_-]{16,128}")


def read_tokens(folder: str) -> Mapping[str, str]:
    """Read every token file in `folder` as token -> role. Raises ConfigError for an invalid file."""
    if not folder:
        return {}
    files = {role: home_path(folder) / f"{role}.token" for role in ROLES}
    tokens = {_read(file): role for role, file in files.items() if file.is_file()}
    if len(tokens) < sum(file.is_file() for file in files.values()):
        raise ConfigError(f"{folder} contains the same token for two roles; create a token for each role")
    return tokens


def own_token(folder: str, source: str) -> str:
    """Return the token that a link of role `source` shows when it connects, or "" without a token."""
    file = home_path(folder) / f"{certificate_role(source)}.token"
    return _read(file) if folder and file.is_file() else ""


def _read(file: Path) -> str:
    try:
        token = file.read_text("ascii", "replace").strip()
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror}; make it readable for this account") from None
    if not _TOKEN.fullmatch(token):
        raise ConfigError(
            f"{file} contains no token: expected 16 to 128 letters, digits, '_' or '-'; try `openssl rand -hex 16`"
        )
    return token


# Access to a WebSocket endpoint: by token, or for the legacy protocol by address. Pure.


# Counter of clients of the legacy protocol from an address that the owner did not list.
NOT_LISTED: Final = "NOT_LISTED"
# Counter of clients without a valid token.
NO_TOKEN: Final = "NO_TOKEN"

_BEARER: Final = "bearer "
_ENTRY: Final = "sightline.token."


def check_listening(endpoint: WebSocketEndpoint, tokens: Mapping[str, str]) -> None:
    """Raise ConfigError for an endpoint that would accept every client on the network."""
    if endpoint.is_loopback:
        return
    if endpoint.legacy is None and not tokens:
        raise ConfigError(
            f"{endpoint.text} accepts network clients without a token; pass --secure DIR with a token "
            "for each role (DIR/vision.token ...), or listen on 127.0.0.1"
        )
    if endpoint.legacy is not None and not endpoint.allow_from:
        option = with_allowed(endpoint.text, ["192.168.1.7"])
        raise ConfigError(
            f"{endpoint.text} accepts network clients without a token (legacy protocol); list their addresses, "
            f'legacy.allow_from = ["192.168.1.7"] or {option}'
        )


def client_address_problem(address: str, allow_from: Sequence[str]) -> str:
    """Return the reason to reject a client, or "" to accept it. An empty list accepts every address.

    Args:
        address: IP address of the client.
        allow_from: addresses and networks that the owner listed.
    """
    # An IPv6 socket shows an IPv4 client as ::ffff:a.b.c.d, which no IPv4 network contains.
    here = ipaddress.ip_address(address.partition("%")[0])
    here = getattr(here, "ipv4_mapped", None) or here
    if not allow_from or any(here in ipaddress.ip_network(network) for network in allow_from):
        return ""
    return f"{address} is not listed in legacy.allow_from of the robot"


def role_of_token(tokens: Mapping[str, str], authorizations: Sequence[str], offers: Sequence[str]) -> str | None:
    """Find the role of a client by its token.

    Args:
        tokens: token -> role.
        authorizations: the `Authorization` headers of the client.
        offers: its `Sec-WebSocket-Protocol` headers, because a browser cannot set `Authorization`.

    Returns:
        The role, or None without exactly one valid token.
    """
    shown = [text[len(_BEARER) :].strip() for text in authorizations if text.lower().startswith(_BEARER)]
    entries = [entry.strip() for offer in offers for entry in offer.split(",")]
    shown += [entry[len(_ENTRY) :] for entry in entries if entry.startswith(_ENTRY)]
    if len(shown) != 1:
        return None
    # Every token is compared, in constant time. Otherwise the response time reveals the correct part of a guess.
    matches = [role for token, role in tokens.items() if hmac.compare_digest(token.encode(), shown[0].encode())]
    return matches[0] if matches else None


def bearer_header(token: str) -> str:
    """Return the `Authorization` header for `token`."""
    return f"Bearer {token}"


def grants_of_role(role: str) -> frozenset[tuple[str, ...]]:
    """Return the (channel, source) pairs that `role` may publish, for a robot only (channel,)."""
    return frozenset(tuple(key.replace("/*/", "/", 1).split("/")[1:]) for key in may_publish(role))
