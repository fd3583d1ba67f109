"""The sockets that a library opened in this process: they are found, and one of Zenoh does not wait when it closes."""

import os
import socket
import struct

import pytest

from sightline.protocol.transports.sockets import close_without_waiting, own_sockets


def linger(one):
    """Return whether a socket waits when it closes, and the time in seconds, which counts only then."""
    return struct.unpack("ii", one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))


def test_each_open_socket_of_this_process_is_found_and_can_be_chosen():
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        wanted = f"socket:[{os.fstat(server.fileno()).st_ino}]"
        assert [one.getsockname() for one in own_sockets(wanted.__eq__)] == [server.getsockname()]
        assert {server.getsockname(), other.getsockname()} <= {one.getsockname() for one in own_sockets()}


@pytest.mark.parametrize(("before", "after"), [((1, 10), (0, 10)), ((1, 3), (1, 3)), ((0, 0), (0, 0))])
def test_only_a_connection_with_the_time_to_linger_of_zenoh_is_changed(before, after):
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", *before))
        close_without_waiting()
        assert linger(one) == after
