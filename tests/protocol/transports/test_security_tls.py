"""`wss://` with real TLS: certificates of a private authority, and every peer that does not agree on them."""

import datetime
import socket
import ssl
import time

import pytest
import trustme
import websocket

from sightline.operator_side.setup import keys
from sightline.protocol.channels import FRAME, TWIST
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.websocket import peer, server
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.server import NO_TLS
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.websocket import address_of

AUTHORITY, STRANGER = trustme.CA(), trustme.CA()


def folder_of(path, authority=AUTHORITY, host="127.0.0.1"):
    """A robot's folder, which is here also that of its vision."""
    path.mkdir(exist_ok=True)
    certificate = authority.issue_cert(host)
    certificate.private_key_pem.write_to_path(path / "robot.key")
    certificate.cert_chain_pems[0].write_to_path(path / "robot.pem")
    authority.cert_pem.write_to_path(path / "ca.pem")
    (path / "vision.token").write_text("0123456789abcdef")
    return str(path)


def client_of(endpoint, folder):
    """A client of another library that reads only on request.

    `websockets.sync` reads in a thread of its own, also while another writes. OpenSSL forbids that for one connection,
    and 1 handshake of 750 hangs.
    """
    return websocket.create_connection(
        endpoint, timeout=10, sslopt={"ca_certs": f"{folder}/ca.pem"},
        subprotocols=["sightline.v1", "sightline.token.0123456789abcdef"],
    )  # fmt: skip


@pytest.fixture
def secured(tmp_path):
    endpoint, folder = free_endpoint("wss://"), folder_of(tmp_path / "keys")
    with open_websocket("r1", listen=endpoint, role="robot", secure=folder) as robot:
        yield robot, endpoint, folder


def test_frames_and_twists_of_any_size_go_both_ways(secured):
    robot, endpoint, folder = secured
    twists = robot.latest(TWIST)
    with open_websocket("r1", connect=endpoint, role="vision", secure=folder) as vision:
        frames = vision.latest(FRAME)
        assert until(lambda: robot.has_listener(FRAME) and vision.has_listener(TWIST))
        for size in (0, 1, 16_384, 16_385, 65_536, 400_000, FRAME.max_payload_bytes):
            assert robot.publish(FRAME, b"{}", bytes(size))
            assert len(frames.take(3).payload) == size
            assert vision.publish(TWIST, b"{}", b"%d|0" % size)
            assert twists.take(3).payload == b"%d|0" % size


def test_a_hundred_frames_while_many_twists_come_in(secured):
    robot, endpoint, folder = secured
    got = []
    with open_websocket("r1", connect=endpoint, role="vision", secure=folder) as vision:
        robot.subscribe(TWIST, lambda message: got.append(message.payload))
        frames = vision.latest(FRAME)
        assert until(lambda: robot.has_listener(FRAME) and vision.has_listener(TWIST))
        for number in range(100):
            robot.publish(FRAME, b"{}", number.to_bytes(4) + bytes(46_000))
            for part in range(3):
                vision.publish(TWIST, b"{}", b"%d|%d" % (number, part))
            assert until(lambda: (frame := frames.take(0.5)) and frame.payload[:4] == number.to_bytes(4))  # noqa: B023
        assert until(lambda: got[-1] == b"99|2")
        assert robot.rejected == vision.rejected == {}


def test_tls_client_that_never_reads_stays_and_delays_no_peer(secured, monkeypatch):
    for module in (server, peer):  # a busy machine makes a slow client
        monkeypatch.setattr(module, "OPEN_S", 10.0)
    robot, endpoint, folder = secured
    stalled = client_of(endpoint, folder)
    with open_websocket("r1", connect=endpoint, role="vision", secure=folder) as vision:
        frames = vision.latest(FRAME)
        stalled.send('{"robot":"r1","session":"0000beef","wants":["frame"]}')
        assert until(lambda: [peer.subscribes_to(FRAME) for peer in robot._peers] == [True, True])
        for number in range(100):
            begin_s = time.monotonic()
            robot.publish(FRAME, b"{}", number.to_bytes(4) + bytes(200_000))
            assert frames.take(1).payload[:4] == number.to_bytes(4)
            time.sleep(max(0.0, 1 / 30 - (time.monotonic() - begin_s)))
        assert len(robot._peers) == 2
    stalled.sock.close()


def test_a_robot_whose_authority_is_not_trusted_is_rejected_in_one_line(secured, tmp_path):
    robot, endpoint, _ = secured
    other = folder_of(tmp_path / "other", STRANGER)
    for folder in (other, ""):
        with pytest.raises(LinkError, match="no TLS: unable to get local issuer certificate; use the ca") as why:
            open_websocket("r1", connect=endpoint, role="vision", secure=folder)
        assert "\n" not in str(why.value)
    assert until(lambda: robot.rejected[NO_TLS] >= 2)


def test_a_certificate_of_another_host_is_rejected(tmp_path):
    endpoint, folder = free_endpoint("wss://"), folder_of(tmp_path / "keys", host="192.0.2.9")
    with (
        open_websocket("r1", listen=endpoint, role="robot", secure=folder),
        pytest.raises(LinkError, match="no TLS: IP address mismatch"),
    ):
        open_websocket("r1", connect=endpoint, role="vision", secure=folder)


@pytest.mark.parametrize(("days", "fix"), [
    ((-9, -1), "certificate has expired; make new keys, or set the clock"),
    ((1, 9), "certificate is not yet valid; set the clock of this machine"),
])
def test_certificate_that_is_not_valid_now_is_reported_with_its_fix(tmp_path, days, fix):
    endpoint, folder = free_endpoint("wss://"), folder_of(tmp_path / "keys")
    begins, ends = (datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=one) for one in days)
    issued = AUTHORITY.issue_cert("127.0.0.1", not_before=begins, not_after=ends)
    issued.private_key_pem.write_to_path(tmp_path / "keys/robot.key")
    issued.cert_chain_pems[0].write_to_path(tmp_path / "keys/robot.pem")
    with (
        open_websocket("r1", listen=endpoint, role="robot", secure=folder),
        pytest.raises(LinkError, match=f"no TLS: {fix}"),
    ):
        open_websocket("r1", connect=endpoint, role="vision", secure=folder)


def test_client_without_tls_is_counted_and_closed(secured, caplog):
    robot, endpoint, folder = secured
    with socket.create_connection(address_of(endpoint)) as near:
        near.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert until(lambda: robot.rejected == {NO_TLS: 1})
    assert until(lambda: "rejected 127.0.0.1 (no TLS: HTTP_REQUEST" in caplog.text)  # counted first, then logged
    open_websocket("r1", connect=endpoint, role="vision", secure=folder).close()


def test_slow_handshake_ends_at_its_deadline(secured):
    robot, endpoint, folder = secured
    hello = ssl.MemoryBIO()
    offer = ssl.create_default_context().wrap_bio(ssl.MemoryBIO(), hello, server_hostname="127.0.0.1")
    with pytest.raises(ssl.SSLWantReadError):
        offer.do_handshake()
    begin_s = time.monotonic()
    with socket.create_connection(address_of(endpoint)) as near:
        for byte in hello.read():
            if robot.rejected[NO_TLS]:
                break
            near.send(bytes([byte]))
            time.sleep(0.03)
        assert until(lambda: robot.rejected == {NO_TLS: 1}, 1)
    assert 1.8 < time.monotonic() - begin_s < 3
    open_websocket("r1", connect=endpoint, role="vision", secure=folder).close()


def test_other_library_connects_over_tls_with_its_token(secured):
    _, endpoint, folder = secured
    stranger = client_of(endpoint, folder)
    stranger.send('{"robot":"r1","session":"0000beef"}')
    assert '"robot":"r1"' in stranger.recv()
    stranger.close()


@pytest.mark.parametrize("missing", ["robot.pem", "robot.key"])
def test_folder_with_missing_keys_is_one_line(tmp_path, missing):
    folder = folder_of(tmp_path / "keys")
    (tmp_path / "keys" / missing).unlink()
    with pytest.raises(ConfigError, match=r"wss:// needs robot\.pem and robot\.key in a folder; pass --s"):
        open_websocket("r1", listen=free_endpoint("wss://"), role="robot", secure=folder)


@pytest.mark.parametrize("broken", ["robot.pem", "robot.key", "ca.pem"])
def test_a_broken_file_is_named_in_one_line(tmp_path, broken):
    folder = folder_of(tmp_path / "keys")
    (tmp_path / "keys" / broken).write_text("nonsense")
    end, role = ("connect", "vision") if broken == "ca.pem" else ("listen", "robot")
    with pytest.raises(ConfigError, match=broken.replace(".", r"\.")) as why:
        open_websocket("r1", secure=folder, role=role, **{end: free_endpoint("wss://")})
    assert "\n" not in str(why.value)


def test_folder_of_sightline_keys_serves_both_ends(tmp_path):
    keys.make(tmp_path, [])
    endpoint = free_endpoint("wss://").replace("127.0.0.1", "0.0.0.0")
    with open_websocket("r1", listen=endpoint, role="robot", secure=str(tmp_path)) as robot:
        twists = robot.latest(TWIST)
        here = endpoint.replace("0.0.0.0", "127.0.0.1")
        with open_websocket("r1", connect=here, role="vision", secure=str(tmp_path)) as vision:
            assert until(lambda: vision.has_listener(TWIST))
            vision.publish(TWIST, b"{}", b"0.1|0")
            assert twists.take(2).source == "vision"
        assert robot.rejected == {}
