"""The transport of a broker."""

from heliograph.numerics.check import fail
from heliograph.serving.brokers.partition import WHOLE, Part
from heliograph.serving.brokers.translator import Translator
from heliograph.serving.brokers.transport import Transport
from heliograph.serving.brokers.url import Address


def connected(address: Address, part: Part = WHOLE, translator: Translator | None = None) -> Transport:
    """Return the transport for one part of the plants through the broker at this address.

    Args:
        address: the broker; its `kind`, mqtt or nats, selects the protocol.
        part: the part of the plants whose messages are read; by default all.
        translator: what reads the topics of others; None reads those of the service alone.

    Raises:
        ValueError: an OPC UA server without sources.
    """
    if address.kind == "opc.tcp":
        if translator is None:
            raise fail(f"{address}", "sources in the network's file, by identifiers of variables", "none")
        from heliograph.serving.brokers.opcua import OpcUa

        return OpcUa(address, translator)
    if address.kind == "mqtt":
        from heliograph.serving.brokers.mqtt import Mqtt

        return Mqtt(address, part, translator)
    from heliograph.serving.brokers.nats import Nats

    return Nats(address, part, translator)
