"""Who was turned away at a TLS door: Zenoh's lines in words, in few lines, with the host where the kernel knows it."""

import random
import socket
import subprocess
import sys

import pytest

from sightline.protocol.log import RepeatLimiter
from sightline.protocol.transports.zenoh import access_log as tcp_table
from sightline.protocol.transports.zenoh.access_log import Certificates, Visitors, refusal_cause
from tests.fixtures.links import free_endpoint, until

SECOND_US = 1_000_000
_HEAD = (
    "\x1b[2m2026-11-22T00:33:14.361880Z\x1b[0m \x1b[33m WARN\x1b[0m acc-0 ThreadId(05) \x1b[2m{}\x1b[0m\x1b[2m:\x1b[0m "
)
_HINT = ". Hint: increase the system open file limit.\n"


def _line(text, module="zenoh_link_tls::unicast"):
    return _HEAD.format(module) + text + _HINT


def _quic(text):
    return _line(f"QUIC acceptor failed: {text} at src/quic/unicast.rs:686.", "zenoh_link_commons::quic::unicast")


_EXPIRED = "invalid peer certificate: certificate expired: verification time 17 (UNIX), but not valid after 16"


@pytest.mark.parametrize(("line", "words"), [
    (_line("received corrupt message of type InvalidContentType"), "it does not speak TLS"),
    (_line("peer sent no certificates"), "it shows no certificate"),
    (_line("invalid peer certificate: UnknownIssuer"), "its certificate is of another authority"),
    (_line("invalid peer certificate: BadSignature"), "its certificate is of another authority"),
    (_line("received fatal alert: DecryptError"), "it does not know our certificate's authority"),
    (_line("received fatal alert: UnknownCA"), "it does not know our certificate's authority"),
    (_line(_EXPIRED), "its certificate has expired"),
    (_line("received fatal alert: CertificateExpired"), "it finds our certificate expired"),
    (_line("received fatal alert: BadCertificate"), "our certificate does not name the address"),
    (_line("Timeout during TLS handshake"), "it opened a connection and said nothing"),
    (_quic('ConnectionClosed(ConnectionClose { reason: b"invalid peer certificate: BadSignature" })'),
     "it does not know our certificate's authority"),
    (_quic(f'TransportError(Error {{ reason: "{_EXPIRED}" }})'), "its certificate has expired"),
    (_quic(f'ConnectionClosed(ConnectionClose {{ reason: b"{_EXPIRED}" }})'), "it finds our certificate expired"),
    (_line("something quite new"), "TLS: something quite new"),
])  # fmt: skip
def test_every_cause_has_its_words(line, words):
    cause = refusal_cause(line)
    assert cause.startswith(words) and "\n" not in cause and len(cause) < 150


@pytest.mark.parametrize("text", ["tls handshake eof", "Connection reset by peer (os error 104)"])
def test_who_leaves_before_the_handshake_is_not_worth_a_word(text):
    assert refusal_cause(_line(text)) == ""


@pytest.mark.parametrize("line", [
    "", "robot r1: on tls/0.0.0.0:7447, camera sim\n", "vision: WARN zenoh_link_tls\n", _line("x", "zenoh::net"),
    "\x1b[",
    "2026-11-22T00:33:14Z  INFO acc-0 ThreadId(05) zenoh_link_tls::unicast: listening\n",
])  # fmt: skip
def test_whatever_else_is_said_is_none_of_it(line):
    assert refusal_cause(line) is None


def test_a_cause_is_told_at_once_and_then_ever_more_seldom_with_every_one_counted():
    lines, told = RepeatLimiter(), {}
    for second in range(200):
        for tenth in range(10):
            now_us = second * SECOND_US + tenth * 100_000
            times = lines.is_due("wrong keys", now_us)
            if times:
                told[now_us / SECOND_US] = times
    assert list(told)[:7] == [0.0, 1.0, 3.0, 7.0, 15.0, 31.0, 63.0] and len(told) <= 10
    assert sum(told.values()) >= list(told)[-1] * 10


def test_two_causes_do_not_hide_one_another_and_an_old_one_is_news_again():
    lines = RepeatLimiter()
    assert (lines.is_due("a", 0), lines.is_due("b", 1), lines.is_due("a", 2)) == (1, 1, 0)
    assert lines.is_due("a", 200 * SECOND_US) == 2
    assert lines.is_due("a", 201 * SECOND_US) == 1


def test_ever_new_causes_take_no_memory():
    lines, draw = RepeatLimiter(), random.Random(3)
    for number in range(2_000):
        assert lines.is_due(f"{draw.random()}", number * 1_000) == 1
    assert len(lines._told) + len(lines._untold) <= 33


# --- what access rules turned away ------------------------------------------------------------------------------------


def _accepted(end, role, kind="TLS"):
    return (_HEAD.format(f"zenoh_link_{kind.lower()}::unicast").replace(" WARN", "DEBUG")
            + f"Accepted {kind} connection on 127.0.0.1:7447: {end}. Common Name: {role}.\n")


def test_who_is_connected_is_named_by_certificate_the_newest_first():
    known = Certificates()
    lines = [_accepted("10.0.0.7:1", "vision"), _accepted("[fe80::1]:2", "viewer"), _accepted("10.0.0.9:3", "operator"),
             _accepted("[::ffff:10.0.0.8]:4", "viewer", "QUIC")]
    assert all(known.note(line) for line in lines)
    assert known.connected({"10.0.0.7:1", "fe80::1:2", "1.2.3.4:5"}) == "viewer from fe80::1 or vision from 10.0.0.7"
    assert known.connected({"10.0.0.8:4"}) == "viewer from 10.0.0.8" and known.connected(set()) == ""
    assert known.note(_accepted("10.0.0.7:1", "viewer")) and known.connected({"10.0.0.7:1"}) == "viewer from 10.0.0.7"


def test_what_is_no_line_of_ours_is_left_to_others():
    known = Certificates()
    for line in ("", "robot r1: on tls/0.0.0.0:7447", _line("tls handshake eof"), "Accepted TLS connection on x: y:1."):
        assert not known.note(line)
    assert known.note(_HEAD.format("zenoh_link_tls::unicast").replace(" WARN", "DEBUG") + "Closing TLS link")


def test_ever_new_connections_take_no_memory_and_a_crowd_is_counted():
    known = Certificates()
    for number in range(2_000):
        known.note(_accepted(f"10.0.{number // 256}.{number % 256}:7", "viewer"))
    assert len(known._roles) == 256
    assert known.connected(known._roles).endswith("viewer from 10.0.7.204 or 252 others")


# --- the kernel's table ----------------------------------------------------------------------------------------------

_ROWS = "  sl  local_address rem_address   st\n   0: {local} {remote} {state} 0 0 0 0\n"


@pytest.mark.parametrize(("table", "local", "remote", "host"), [
    ("tcp", "0100007F:1D17", "0701A8C0:C001", "192.168.1.7"),
    ("tcp6", "00000000000000000000000000000000:1D17", "0000000000000000FFFF00000701A8C0:C001", "192.168.1.7"),
    ("tcp6", "00000000000000000000000000000000:1D17", "000080FE000000000000000001000000:C001", "fe80::1"),
])  # fmt: skip
def test_a_far_end_is_read_from_the_table(monkeypatch, tmp_path, table, local, remote, host):
    (tmp_path / table).write_text(_ROWS.format(local=local, remote=remote, state="06"))
    monkeypatch.setattr(tcp_table, "TABLES", tmp_path)
    visitors = Visitors([0x1D17])
    assert visitors.here() == set() and visitors.who_left(0.0) == host
    assert visitors.who_left(0.0) == "", "it left once"
    assert Visitors([0x1D18]).who_left(0.0) == ""


def test_who_comes_and_goes_is_named_and_who_stays_is_not():
    """A connection of another process that is reset leaves no trace but its absence."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        knock = ("import socket, struct, time\n"
                 f"s = socket.create_connection(('127.0.0.1', {port})); time.sleep(0.2)\n"
                 "s.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0)); s.close()")
        with socket.create_connection(("127.0.0.1", port)):
            assert Visitors([port]).who_left(0.05) == ""
            with subprocess.Popen([sys.executable, "-c", knock]):
                assert Visitors([port]).who_left(5.0) == "127.0.0.1"


@pytest.mark.slow
@pytest.mark.parametrize("log", ["text", "json"])
def test_a_router_names_who_it_refuses_among_its_own_lines(tmp_path, log):
    from sightline.operator_side.setup import keys

    keys.make(tmp_path / "k", [])
    endpoint = free_endpoint().replace("tcp/", "tls/")
    port = int(endpoint.rpartition(":")[2])
    command = [
        sys.executable,
        "-P",
        "-m",
        "sightline.operator_side.cli.app",
        "router",
        "--listen",
        endpoint,
        "--secure",
        str(tmp_path / "k"),
        "--log",
        log,
    ]
    out = (tmp_path / "out").open("w+")
    with subprocess.Popen(command, stdout=out, stderr=out) as router:
        try:
            assert until(lambda: "router: on " in (tmp_path / "out").read_text(), 8)
            for _ in range(3):
                with socket.create_connection(("127.0.0.1", port)) as plain:
                    plain.sendall(b"hello, this is no TLS at all")
                    plain.recv(1)
            assert until(lambda: "it does not speak TLS" in (tmp_path / "out").read_text(), 2)
        finally:
            router.terminate()
            assert router.wait(5) == 0
    said = (tmp_path / "out").read_text().splitlines()
    refused = [line for line in said if "refused a connection from 127.0.0.1 at " in line]
    assert 1 <= len(refused) <= 2 and "ended" in said[-1]
    assert all(line.startswith('{"time":' if log == "json" else "router: ") for line in said), said
