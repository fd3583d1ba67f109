"""What waits to be printed: of pictures the newest alone, of words some, and never more than a bound."""

import pytest

from sightline.operator_side.client.messages import MAX_WAITING, ChannelInbox
from sightline.protocol.channels import CHANNELS, JPEG
from sightline.protocol.transports.memory import MemoryNetwork
from tests.operator_side.client.test_messages import usual

PICTURES = [name for name, one in CHANNELS.items() if one.encoding == JPEG]


def heard(name, count):
    """An inbox in which `count` messages of a channel arrived, told apart by their payloads' last byte."""
    network = MemoryNetwork(seed=1)
    inbox = ChannelInbox(network.link("r1", role="operator"), "operator", CHANNELS[name])
    messages = [usual(name, payload=usual(name).payload + bytes([number])) for number in range(count)]
    for message in messages:
        inbox._put(message)
    return inbox, messages


@pytest.mark.parametrize("name", PICTURES)
def test_only_the_newest_picture_waits(name):
    inbox, messages = heard(name, 5)
    assert inbox.take(0.0) == messages[-1] and inbox.take(0.0) is None and inbox.dropped == 4


def test_words_wait_in_order_up_to_a_bound():
    inbox, messages = heard("status", MAX_WAITING + 3)
    assert [inbox.take(0.0) for _ in range(MAX_WAITING)] == messages[:MAX_WAITING]
    assert inbox.take(0.0) is None and inbox.dropped == 3
