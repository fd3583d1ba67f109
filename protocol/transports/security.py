"""Who may say and hear what on a secured link: mutual TLS, access rules from the channel table. Shell (seeks files).

A role is the common name of a certificate. Zenoh judges by inclusion and at every hop, and says nothing to who is
denied: whoever listens denies all that is not listed here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sightline.protocol.channels import CHANNELS, KEY_PREFIX, MAX_HEADER_BYTES, REQUEST, Channel, Direction
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.endpoints import parse_zenoh_endpoint

ROBOT_ROLE: Final = "robot"
SOURCES_OF_ROLE: Final[dict[str, tuple[str, ...]]] = {
    "vision": ("vision",),
    "operator": ("operator", "teleop"),
    "detector": ("detector",),
    "viewer": (),
}
"""Role of a certificate -> the sources it may speak as towards a robot. A detector says what it sees and no more, a
viewer nothing, not even `ack`."""
KNOWN_SOURCES: Final = frozenset(source for sources in SOURCES_OF_ROLE.values() for source in sources)
"""The sources that a role speaks as; any other is made up by its peer, and possible only on a link without keys."""
ROLES: Final = (ROBOT_ROLE, *SOURCES_OF_ROLE)
PRESENCE_PREFIX: Final = "sightline-presence"
"""Where peers say that they are there (`sightline.protocol.transports.zenoh.presence`): beside `sightline/`, the keys of channels."""
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
