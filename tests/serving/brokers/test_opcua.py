"""Values of an OPC UA server that the tests start: its deadband is read, asked for, and the sender's of a node."""

import asyncio

import pytest

pytest.importorskip("asyncua")
from asyncua import Server, ua

import heliograph as hg
from heliograph.numerics.check import InputError
from heliograph.serving.brokers.opcua import Reporting, read_reporting, reporting_of
from heliograph.serving.brokers.translator import Translator
from heliograph.serving.brokers.transport import connected
from heliograph.serving.brokers.url import address
from heliograph_studies.live.server import free_port

VARIABLE = "ns=2;s=Boiler.Temperature"


def network() -> hg.Network:
    plant = hg.Plant(lambda x, u: x + 0.0 * u[0], [[0.1]], [20.0], [[1.0]], states=["t"], inputs=["dt"])
    return hg.Network(plant, {"boiler": hg.Node(hg.Sensor(lambda x: x, 0.1), hg.perfect(), {})})


async def served(port: int) -> Server:
    """A server with a variable that states a deadband of 0.5 and a sampling interval of 100 ms."""
    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/plant")
    space = await server.register_namespace("heliograph")
    variable = await server.nodes.objects.add_variable(ua.NodeId("Boiler.Temperature", space), "Temperature", 20.0)
    await variable.add_property(space, "ExceptionDeviation", 0.5)
    await variable.write_attribute(
        ua.AttributeIds.MinimumSamplingInterval, ua.DataValue(ua.Variant(100.0, ua.VariantType.Double))
    )
    await server.start()
    return server


def test_a_deadband_is_the_sender_of_a_node():
    trigger = Reporting(0.5, 0.1).trigger(heartbeat=60)
    assert trigger.delta == 0.5 and trigger.heartbeat == 60
    with pytest.raises(InputError, match=r"deadband of the server: expected a positive number, got 0\.0"):
        Reporting(0.0, 0.1).trigger()


def test_a_server_needs_sources_and_an_answer():
    where = address("opc.tcp://me:secret@127.0.0.1:4840/plant", {})
    assert str(where) == "opc.tcp://127.0.0.1:4840/plant" and "secret" not in repr(where)
    with pytest.raises(InputError, match=r"opc\.tcp://.*: expected sources in the network's file"):
        connected(where)


@pytest.mark.real("OPC UA")
def test_what_the_server_states_is_read_and_subscribed():
    """Of 20.0, 20.3 and 21.0 the second is within the deadband of the first, and is not sent."""

    async def work() -> None:
        port = free_port()
        server = await served(port)
        sources = {VARIABLE: hg.files.json_field("value", "boiler", time="source_time")}
        where = address(f"opc.tcp://127.0.0.1:{port}/plant", {})
        transport = connected(where, translator=Translator(sources, network()))
        try:
            variable = server.get_node(VARIABLE)
            assert await reporting_of(variable) == Reporting(0.5, 0.1)
            values = []
            for value in (None, 20.3, 21.0):
                if value is not None:
                    await variable.write_value(value)
                    await asyncio.sleep(0.5)
                if value != 20.3:
                    batch = await asyncio.wait_for(transport.receive(), 30)
                    values += [message.values[0] for message in batch.payloads]
            assert values == [20.0, 21.0] and transport.reporting == {VARIABLE: Reporting(0.5, 0.1)}
        finally:
            await transport.close()
            await server.stop()

    asyncio.run(work())


@pytest.mark.real("OPC UA")
def test_no_server_is_one_line():
    with pytest.raises(InputError, match=r"^OPC UA server opc\.tcp://127\.0\.0\.1:\d+/: expected an answer, got "):
        read_reporting(f"opc.tcp://127.0.0.1:{free_port()}", [VARIABLE])
