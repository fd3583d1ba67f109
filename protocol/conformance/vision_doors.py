"""Cases about how a vision opens a WebSocket: its token, its names, and a robot that falls silent. Shell (sockets)."""

from typing import Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.vision.websocket import RawClient
from sightline.protocol.conformance.vision_sockets import BACK_S, client_of, ends, met, need_websocket, server_of

SUITE = Suite("V")
_ENTRY: Final = "sightline.token."
_BEARER: Final = "bearer "


def _token(bench: Bench) -> str:
    need_websocket(bench)
    token = bench.access.token_of("vision")
    bench.need(token, "no token was named (--token, or --secure)")
    return token


def _shown(client: RawClient) -> list[str]:
    """Every token that the client showed, in either way."""
    bearers = (value for name, value in client.headers if name == "authorization")
    shown = [text[len(_BEARER) :].strip() for text in bearers if text.lower().startswith(_BEARER)]
    return shown + [entry[len(_ENTRY) :] for entry in client.offered if entry.startswith(_ENTRY)]


@SUITE.must("V-SOCK-14", "14.3 Token", real=True)
def shows_its_token(bench: Bench) -> None:
    """It shows its token, and shows it once: beside the sub-protocol, or as `Authorization: Bearer`."""
    token = _token(bench)
    with server_of(bench) as server:
        shown = _shown(client_of(bench, server))
        bench.expect(len(shown) == 1, f"it shows {len(shown)} tokens")
        bench.expect(shown == [token], "it shows another token than the one named")


@SUITE.must("V-SOCK-15", "14.3 Token", real=True)
def token_is_in_no_url(bench: Bench) -> None:
    """No token is in its URL, which is logged."""
    token = _token(bench)
    with server_of(bench) as server:
        bench.expect(token not in client_of(bench, server).request, "its URL holds the token")


@SUITE.must("V-SOCK-16", "14.2 Host and Origin", real=True)
def names_its_host(bench: Bench) -> None:
    """It names one Host, and no Origin but that Host."""
    with server_of(bench) as server:
        said = client_of(bench, server).headers
        hosts = [value.lower() for name, value in said if name == "host"]
        bench.expect(len(hosts) == 1, f"it names {len(hosts)} hosts")
        origins = [value.lower() for name, value in said if name == "origin"]
        own = {f"http://{hosts[0]}", f"https://{hosts[0]}"}
        bench.expect(set(origins) <= own, f"Origin {origins}, Host {hosts[0]}")


@SUITE.must("V-SOCK-17", "14.8 Liveness", real=True)
def leaves_the_silent(bench: Bench) -> None:
    """A robot that says nothing and answers no ping is given up, and connected to again."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.answers_pings = False
        bench.expect(ends(client, BACK_S), f"after {BACK_S:g} s without a word it is still connected")
        bench.expect(server.accept(BACK_S), f"it did not connect again within {BACK_S:g} s")
