"""The tokens of roles in a `--secure` folder, one file each: `vision.token`, `operator.token` ... Shell (reads files).

Who shows the text of one comes in as that role.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.security import ROLES, certificate_role

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
