"""Cases on tokens: who may come in where a robot asks for one, and what a role may say then. Shell (raw sockets)."""

from typing import Any, Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.raw_peers import BINARY, TEXT, RawWebSocket
from sightline.conformance.robot.websocket import (
    SOON_S,
    SWITCHED,
    block,
    disarm_request,
    endpoint_of,
    entry_of,
    hello,
    is_answered,
    offered,
)
from sightline.protocol.transports.websocket.framing import SUBPROTOCOL

SUITE: Final = Suite("R")
_CLAUSE: Final = "14.3 Token"
_WRONG_TOKENS: Final = "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA"
"""A token by its form, and nobody's."""


def _token(bench: Bench) -> str:
    endpoint_of(bench)
    token = bench.access.token_of(bench.access.watcher)
    bench.need(token, "no token was named (--token, or --secure): a robot on loopback need not ask for one")
    return token


def _answers(bench: Bench, status: int, what: str, **options: Any) -> None:
    """Fail the case unless a client who comes so gets `status`."""
    with RawWebSocket(endpoint_of(bench), **{"protocols": (SUBPROTOCOL,), **options}) as raw:
        bench.expect(raw.status == status, f"{what}: HTTP {raw.status or 'nothing'}, expected {status}")


@SUITE.must("R-SOCK-34", _CLAUSE, real=True)
def no_token(bench: Bench) -> None:
    """Who shows no token is refused with 401."""
    _token(bench)
    _answers(bench, 401, "no token")


@SUITE.must("R-SOCK-35", _CLAUSE, real=True)
def wrong_token(bench: Bench) -> None:
    """A token that is nobody's, or a part of the right one, is refused with 401."""
    token = _token(bench)
    for what, wrong in (("nobody's token", _WRONG_TOKENS), ("all but its last letter", token[:-1]), ("an empty one", "")):
        _answers(bench, 401, what, protocols=(SUBPROTOCOL, entry_of(wrong)))


@SUITE.must("R-SOCK-36", _CLAUSE, real=True)
def two_tokens(bench: Bench) -> None:
    """Two tokens, though one of them be right, are refused with 401."""
    token = _token(bench)
    _answers(bench, 401, "a second entry", protocols=(SUBPROTOCOL, entry_of(token), entry_of(_WRONG_TOKENS)))
    shown = (("Authorization", f"Bearer {_WRONG_TOKENS}"),)
    _answers(bench, 401, "a second one as bearer", protocols=(SUBPROTOCOL, entry_of(token)), headers=shown)


@SUITE.must("R-SOCK-37", _CLAUSE, real=True)
def token_in_the_url(bench: Bench) -> None:
    """A token in the URL, which is logged, opens nothing: 401."""
    token = _token(bench)
    _answers(bench, 401, "a token in the URL", path=f"/?token={token}")


@SUITE.must("R-SOCK-38", _CLAUSE, real=True)
def token_as_bearer(bench: Bench) -> None:
    """The token is taken as `Authorization: Bearer` too, and HTTP has that word in any case."""
    token = _token(bench)
    for word in ("Bearer", "bearer"):
        _answers(bench, SWITCHED, f"the token as {word}", headers=(("Authorization", f"{word} {token}"),))


@SUITE.must("R-SOCK-39", _CLAUSE, real=True)
def token_is_not_repeated(bench: Bench) -> None:
    """Beside a token `sightline.v1` is selected, wherever it stands, and the token is never repeated."""
    token = _token(bench)
    for protocols in ((entry_of(token), SUBPROTOCOL), (SUBPROTOCOL, entry_of(token))):
        with RawWebSocket(endpoint_of(bench), protocols) as raw:
            bench.expect(raw.status == SWITCHED, f"offered {len(protocols)} entries: HTTP {raw.status}")
            selected = raw.headers.get("sec-websocket-protocol")
            bench.expect(selected == SUBPROTOCOL, "it selects the token" if token in str(selected) else f"{selected!r}")
            bench.expect(not any(token in text for text in raw.headers.values()), "it repeats the token")


@SUITE.must("R-SOCK-40", _CLAUSE, real=True)
def roles_are_kept_apart(bench: Bench) -> None:
    """What the token's role may not publish is dropped, and the connection stays: a vision asks for nothing."""
    _token(bench)
    bench.need(len(set(bench.access.tokens.values())) > 1, "one token stands for every role here")
    with RawWebSocket(endpoint_of(bench), offered(bench, source="vision")) as raw:
        raw.send(TEXT, hello(bench, "reply"))
        bench.need(raw.frame(SOON_S), "hello is not answered (R-SOCK-07)")
        raw.send(BINARY, disarm_request(bench))
        bench.expect(not is_answered(raw, bench), "with the token of a vision an operator's request was carried out")
        raw.send(BINARY, block(b'{"channel":"ack","source":"vision"}'))
        bench.expect(raw.end(0.5) is None, "the connection ended")
