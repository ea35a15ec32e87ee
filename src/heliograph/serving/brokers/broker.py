"""The transport of a broker."""

from heliograph.serving.brokers.partition import WHOLE, Part
from heliograph.serving.brokers.transport import Transport
from heliograph.serving.brokers.url import Address


def connected(address: Address, part: Part = WHOLE) -> Transport:
    """Return the transport for one part of the plants through the broker at this address.

    Args:
        address: the broker; its `kind`, mqtt or nats, selects the protocol.
        part: the part of the plants whose messages are read; by default all.
    """
    if address.kind == "mqtt":
        from heliograph.serving.brokers.mqtt import Mqtt

        return Mqtt(address, part)
    from heliograph.serving.brokers.nats import Nats

    return Nats(address, part)
