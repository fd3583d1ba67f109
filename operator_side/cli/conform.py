"""What `sightline conform` shows at a peer's door: tokens by role, and a folder of keys. Shell (reads files)."""

import ssl
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path

from sightline.protocol.conformance.bench import Access
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.websocket_keys import own_token

_EXAMPLE = "e.g. --token vision=keys/vision.token"


def access_for(secure: str, tokens: Iterable[str], roles: Sequence[str], ending: ExitStack) -> Access:
    """Access with the folder `secure` and with `tokens`, each `ROLE=FILE`, or `FILE` for every one of `roles`.

    Tokens named beside a folder stand before those that lie in it. Raises ConfigError for one that cannot be used.
    """
    if secure and not Path(secure).expanduser().is_dir():
        raise ConfigError(f"--secure {secure}: there is no such folder; make keys with `sightline keys init {secure}`")
    given = _by_role(tokens, roles)
    if given:
        secure = _joined(secure, given, ending)
    own = {role: own_token(secure, role) for role in roles}
    return Access({role: token for role, token in own.items() if token}, secure)


def _by_role(tokens: Iterable[str], roles: Sequence[str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for named in tokens:
        role, equals, file = named.rpartition("=")
        if equals and role not in roles:
            raise ConfigError(f"--token {named}: there is no role {role!r} here, but {', '.join(roles)}; {_EXAMPLE}")
        found.update(dict.fromkeys([role] if role else roles, Path(file).expanduser()))
    return found


def _token_in(file: Path) -> str:
    try:
        return file.read_text("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text"
        raise ConfigError(f"--token {file} cannot be read: {why}; name a file that holds a token, {_EXAMPLE}") from None


def _joined(secure: str, tokens: dict[str, Path], ending: ExitStack) -> str:
    """A folder with the files of `secure` and these tokens in place of its own, gone at the end."""
    folder = Path(ending.enter_context(tempfile.TemporaryDirectory(prefix="sightline-conform-")))
    for file in Path(secure).expanduser().iterdir() if secure else _trusted_here():
        (folder / (file.name if secure else "ca.pem")).symlink_to(file.absolute())
    for role, given in tokens.items():
        own = folder / f"{role}.token"
        own.unlink(missing_ok=True)
        own.touch(mode=0o600)
        own.write_text(_token_in(given), "ascii")
        try:
            own_token(str(folder), role)
        except ConfigError:
            raise ConfigError(f"--token {given} holds no token: 16 to 128 of A-Z a-z 0-9 _ -; {_EXAMPLE}") from None
    return str(folder)


def _trusted_here() -> list[Path]:
    """The authorities that this machine trusts, for a `wss://` whose certificate needs no folder."""
    file = ssl.get_default_verify_paths().cafile
    return [Path(file)] if file else []
