"""A private authority with a certificate and a token for each role. Shell (files).

It uses `cryptography`, as Python's own packaging does. Elliptic-curve keys (P-256) keep the TLS handshake short on a
small robot. A machine should have only `ca.pem` and the files of its own role. A robot with WebSocket also needs all
tokens; robots, routers and operators need `stop.secret`. No machine needs `ca.key`.
"""

from __future__ import annotations

import datetime
import ipaddress
import secrets
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.security import CERTIFICATES, ROUTER_ROLE
from sightline.protocol.transports.stop_port import STOP_SECRET_FILE

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

DAYS = 825
"""Longest validity of a role's certificate that common TLS stacks accept."""
AUTHORITY_DAYS = 3650
"""Long enough to renew the certificates several times, because each machine trusts only this authority."""
STOP = "stop"
"""Name of the STOP secret, next to the roles."""
_TOKEN_BYTES = 24  # 192 bits, 32 letters
LOOPBACK = ("localhost", "127.0.0.1")
_BEGUN_EARLIER = datetime.timedelta(days=1)  # for machines whose clocks differ by hours


@dataclass(frozen=True)
class Certificate:
    """The role, hosts and validity of one certificate file. It expires with its authority at the latest."""

    file: Path
    role: str
    hosts: tuple[str, ...]
    begins: datetime.datetime
    ends: datetime.datetime
    ends_with_authority: bool
    is_foreign: bool = False
    """True if the authority in the folder has not signed it."""

    def problem(self, now: datetime.datetime) -> str:
        """Return the reason why no peer accepts it now, or ""."""
        if self.is_foreign:
            return "of another authority than ca.pem"
        if now < self.begins:
            return f"not valid before {self.begins:%Y-%m-%d}, and the clock of this machine is at {now:%Y-%m-%d}"
        return f"expired on {self.ends:%Y-%m-%d}" if self.ends < now else ""


def make(folder: Path, hosts: Sequence[str], days: float = DAYS) -> list[Path]:
    """Create an authority, and a certificate for each role, valid for `hosts` and loopback. Returns the files.

    Args:
        days: validity of the certificates; that of the authority is `AUTHORITY_DAYS`.

    Raises:
        ConfigError: the folder already has keys or cannot be written. No file is changed.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

    for host in hosts:
        _general_name(host)  # raises for an invalid host before any file is written
    key = ec.generate_private_key(ec.SECP256R1())
    builder = _builder("sightline authority", "sightline authority", key, _days_from_now(AUTHORITY_DAYS))
    builder = builder.add_extension(x509.BasicConstraints(True, 0), True)
    usage = dict.fromkeys(("digital_signature", "content_commitment", "key_encipherment", "data_encipherment",
                           "key_agreement", "encipher_only", "decipher_only"), False)
    builder = builder.add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **usage), True)
    authority = _signed(builder, key)
    files = {**_pair("ca", key, authority), STOP_SECRET_FILE: _random()}
    for role in CERTIFICATES:
        files |= _issued(role, hosts, days, key, authority)
    if present := sorted(name for name in files if (folder / name).exists()):
        raise ConfigError(f"{folder} already has keys ({present[0]}); choose another folder or delete this one")
    return _write(folder, files)


def add(folder: Path, role: str, hosts: Sequence[str], days: float = DAYS) -> list[Path]:
    """Create a new certificate of `role`, signed by the authority in `folder`.

    `STOP` is not a role: it creates the STOP secret. Without `hosts` a new certificate keeps the present hosts. It
    expires with its authority at the latest.

    Raises:
        ConfigError: the role or a host is invalid, the authority has expired or its files are missing or do not belong
            together, or the folder cannot be written. No file is changed.
    """
    if role == STOP:
        return _write_secret(folder)
    if role not in CERTIFICATES:
        raise ConfigError(f"unknown role '{role}'; expected {', '.join(CERTIFICATES)}, or {STOP} for the STOP secret")
    (key, authority), present = _authority(folder), folder / f"{role}.pem"
    if not hosts and present.exists():
        hosts = _hosts(_load(present))
    return _write(folder, _issued(role, hosts, days, key, authority))


def _issued(
    role: str, hosts: Sequence[str], days: float, authority_key: EllipticCurvePrivateKey, authority: x509.Certificate
) -> dict[str, bytes]:
    """Return the files of a new certificate of `role`."""
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID as Usage

    key = ec.generate_private_key(ec.SECP256R1())
    names = [_general_name(host) for host in dict.fromkeys((*LOOPBACK, *hosts))]
    builder = (
        _builder(role, "sightline authority", key, min(_days_from_now(days), authority.not_valid_after_utc))
        .add_extension(x509.BasicConstraints(False, None), True)
        .add_extension(x509.SubjectAlternativeName(names), False)
        .add_extension(x509.ExtendedKeyUsage([Usage.SERVER_AUTH, Usage.CLIENT_AUTH]), False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()), False)
    )
    token = {} if role == ROUTER_ROLE else {f"{role}.token": _random()}
    return {**_pair(role, key, _signed(builder, authority_key)), **token}


def look(folder: Path) -> list[Certificate]:
    """Read the certificates in `folder`. Raises ConfigError without a certificate or for an invalid one."""
    found = {file: _load(file) for file in sorted(folder.glob("*.pem"))}
    if not found:
        raise ConfigError(f"no certificates in {folder}; create them with: sightline keys init {folder}")
    return [_described(file, one, found.get(folder / "ca.pem", one)) for file, one in found.items()]


def _days_from_now(days: float) -> datetime.datetime:
    # The times of a certificate have whole seconds.
    return (datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)).replace(microsecond=0)


def _builder(
    role: str, issuer: str, key: EllipticCurvePrivateKey, ends: datetime.datetime
) -> x509.CertificateBuilder:
    from cryptography import x509

    return (
        x509.CertificateBuilder()
        .subject_name(_name(role))
        .issuer_name(_name(issuer))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_days_from_now(0) - _BEGUN_EARLIER)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False)
    )


def _name(text: str) -> x509.Name:
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _general_name(host: str) -> x509.GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        parts = host.split(".")
        # A name whose last part is a number is a mistyped address.
        if not host.isascii() or not all(part.replace("-", "a").isalnum() for part in parts) or parts[-1].isdigit():
            raise ConfigError(
                f"invalid host '{host}'; expected a name or address, e.g. robot.local or 192.168.1.20"
            ) from None
        return x509.DNSName(host)


def _signed(builder: x509.CertificateBuilder, key: EllipticCurvePrivateKey) -> x509.Certificate:
    from cryptography.hazmat.primitives import hashes

    return builder.sign(key, hashes.SHA256())


def _pair(name: str, key: EllipticCurvePrivateKey, certificate: x509.Certificate) -> dict[str, bytes]:
    from cryptography.hazmat.primitives import serialization as forms

    return {
        f"{name}.key": key.private_bytes(forms.Encoding.PEM, forms.PrivateFormat.PKCS8, forms.NoEncryption()),
        f"{name}.pem": certificate.public_bytes(forms.Encoding.PEM),
    }


def _write_secret(folder: Path) -> list[Path]:
    if not (folder / "ca.pem").is_file():
        raise ConfigError(f"no keys in {folder}; create them with: sightline keys init {folder}")
    return _write(folder, {STOP_SECRET_FILE: _random()})


def _random() -> bytes:
    return secrets.token_urlsafe(_TOKEN_BYTES).encode() + b"\n"


def _write(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write the files, all private except the certificates. A full disk leaves the earlier files unchanged."""
    parts = {folder / name: folder / f".{name}.part" for name in files}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file, part in parts.items():
            part.unlink(missing_ok=True)
            part.touch(mode=0o666 if file.suffix == ".pem" else 0o600)
            part.write_bytes(files[file.name])
        for file, part in parts.items():
            part.replace(file)
    except OSError as error:
        raise ConfigError(f"cannot write keys to {folder}: {error.strerror}; choose another folder") from None
    finally:
        for part in parts.values():
            with suppress(OSError):
                part.unlink(missing_ok=True)
    return list(parts)


def _authority(folder: Path) -> tuple[EllipticCurvePrivateKey, x509.Certificate]:
    """Read the key and the certificate of the authority. Raises ConfigError unless it can sign certificates now."""
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey as Key
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        key = load_pem_private_key((folder / "ca.key").read_bytes(), None)
    except (OSError, ValueError):
        raise ConfigError(f"no authority in {folder}: ca.key is missing or damaged; use the folder of "
                          "`sightline keys init`") from None
    if not isinstance(key, Key):
        raise ConfigError(f"{folder}/ca.key has another kind of key; use the folder of `sightline keys init`")
    certificate = _load(folder / "ca.pem")
    if certificate.public_key() != key.public_key():
        raise ConfigError(f"ca.key and ca.pem in {folder} do not belong together; copy both from one "
                          "`sightline keys init`")
    if certificate.not_valid_after_utc < _days_from_now(0):
        raise ConfigError(f"the authority in {folder} expired on {certificate.not_valid_after_utc:%Y-%m-%d}; create "
                          f"new keys with: sightline keys init {folder}-new")
    return key, certificate


def _load(file: Path) -> x509.Certificate:
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except (OSError, ValueError):
        # The present addresses are unknown, and one damaged certificate does not need new keys for all roles.
        repair = (f"replace it with: sightline keys add {file.parent} {file.stem} --host HOST"
                  if file.stem in CERTIFICATES else f"create new ones with: sightline keys init {file.parent}-new")
        raise ConfigError(f"invalid certificate {file}; {repair}") from None


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    from cryptography import x509

    try:
        alternative = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in alternative)


def _described(file: Path, read: x509.Certificate, authority: x509.Certificate) -> Certificate:
    from cryptography.exceptions import InvalidSignature
    from cryptography.x509.oid import NameOID

    role = str(read.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
    ends = min(read.not_valid_after_utc, authority.not_valid_after_utc)
    is_foreign = False
    try:
        read.verify_directly_issued_by(authority)
    except InvalidSignature:
        is_foreign = True
    except (TypeError, ValueError):  # signed by an authority that `ca.pem` has signed
        pass
    return Certificate(file, role, _hosts(read), read.not_valid_before_utc, ends,
                       ends == authority.not_valid_after_utc, is_foreign)
