"""`oip+http://HOST[:PORT]/MODEL` and its like: the parts of a remote detector's name. Pure."""

import re
from dataclasses import dataclass
from typing import Final

from sightline.protocol.errors import ConfigError

DEFAULT_PORTS: Final = {"oip+http": 8000, "oip+grpc": 8001, "http+jpeg": 80}
"""Those of Triton, and of HTTP."""
_HOST = r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+)"
_FORM = re.compile(rf"(oip\+http|oip\+grpc|http\+jpeg)://{_HOST}(?::([0-9]{{1,5}}))?(/[!-~]*)?")
_MODEL = re.compile(r"/([A-Za-z0-9_.-]{1,128})(?:/([0-9]{1,9}))?")
EXAMPLES: Final = {
    "oip+http": "oip+http://127.0.0.1:8000/ball", "oip+grpc": "oip+grpc://127.0.0.1:8001/ball",
    "http+jpeg": "http+jpeg://127.0.0.1:8080/detect",
}


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server is, and what is asked for there: a path, or a model and perhaps its version."""

    scheme: str
    host: str
    port: int
    path: str
    model: str = ""
    version: str = ""


def is_address(kind: str) -> bool:
    """Whether `kind` names a server, well or badly."""
    return kind.partition("://")[0] in DEFAULT_PORTS and "://" in kind


def parse_address(kind: str) -> Address:
    """Split it. Raises ConfigError, with the right form, for what is none."""
    scheme = kind.partition("://")[0]
    example = EXAMPLES.get(scheme, EXAMPLES["oip+http"])
    match = _FORM.fullmatch(kind)
    port = int(match[3]) if match and match[3] else DEFAULT_PORTS.get(scheme, 0)
    if match is not None and not 1 <= port <= 65_535:
        raise ConfigError(f"detector {kind!r}: there is no port {port}; 1 to 65535, e.g. {example}")
    if match is None:
        raise ConfigError(f"detector {kind!r}: write scheme://HOST[:PORT]/..., e.g. {example}")
    host, path = match[2].strip("[]"), match[4] or "/"
    if scheme == "http+jpeg":
        return Address(scheme, host, port, path)
    named = _MODEL.fullmatch(path)
    if named is None:
        raise ConfigError(f"detector {kind!r} names no model: write {example}, or .../MODEL/VERSION")
    return Address(scheme, host, port, path, named[1], named[2] or "")
