"""The transport of a broker."""

from heliograph.serving.partition import WHOLE, Part
from heliograph.serving.transport import Transport
from heliograph.serving.url import Address


def connected(address: Address, part: Part = WHOLE) -> Transport:
    """Messages of a part of the plants, through the broker at this address."""
    if address.kind == "mqtt":
        from heliograph.serving.mqtt import Mqtt

        return Mqtt(address, part)
    from heliograph.serving.nats import Nats

    return Nats(address, part)
