"""Values of an OPC UA server that the tests start: its deadband is read, asked for, and the sender's of a node."""

import asyncio
import json

import pytest

pytest.importorskip("asyncua")
from asyncua import Server, ua

import heliograph as hg
from heliograph.files.source_suggestions import suggest_sources
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving import make_transport
from heliograph.serving.brokers import listen
from heliograph.serving.brokers.broker_address import parse_address
from heliograph.serving.brokers.opcua import Reporting, read_reporting
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore
from heliograph_studies.live.server import free_port

VARIABLE = "ns=2;s=Boiler.Temperature"


def network() -> hg.Network:
    plant = hg.Plant(lambda x, u: x + 0.0 * u[0], [[0.1]], [20.0], [[1.0]], states=["t"], inputs=["dt"])
    return hg.Network(plant, {"boiler": hg.Node(hg.Sensor(lambda x: x, 0.1), hg.perfect(), {})})


async def served(port: int, percent: bool = False) -> Server:
    """A server with a variable that states a deadband of 0.5 and a sampling interval of 100 ms.

    percent: the deadband is stated as 0.25 percent of a range of 200.
    """
    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/plant")
    space = await server.register_namespace("heliograph")
    variable = await server.nodes.objects.add_variable(ua.NodeId("Boiler.Temperature", space), "Temperature", 20.0)
    await variable.add_property(space, "ExceptionDeviation", 0.25 if percent else 0.5)
    if percent:
        await variable.add_property(space, "ExceptionDeviationFormat", ua.Variant(3, ua.VariantType.Int32))
        await variable.add_property(space, "EURange", ua.Range(-100.0, 100.0))
    await variable.write_attribute(
        ua.AttributeIds.MinimumSamplingInterval, ua.DataValue(ua.Variant(100.0, ua.VariantType.Double))
    )
    await server.start()
    return server


async def stopped(server: Server) -> None:
    """Stop a server, but not wait for its clock, which looks once a second whether to end."""
    server.iserver.time_task.cancel()
    server.iserver.time_task = None
    await server.stop()


def test_a_deadband_is_the_sender_of_a_node():
    trigger = Reporting(0.5, 0.1).trigger(heartbeat=60)
    assert trigger.delta == 0.5 and trigger.heartbeat == 60
    with pytest.raises(hg.InputError, match=r"deadband of the server: expected a positive number, got 0\.0"):
        Reporting(0.0, 0.1).trigger()


def test_a_server_needs_sources_and_an_answer():
    where = parse_address("opc.tcp://me:secret@127.0.0.1:4840/plant", {})
    assert str(where) == "opc.tcp://127.0.0.1:4840/plant" and "secret" not in repr(where)
    with pytest.raises(hg.InputError, match=r"opc\.tcp://.*: expected sources in the network's file"):
        make_transport(where)


@pytest.mark.real("OPC UA")
def test_what_the_server_states_is_read_and_subscribed():
    """Of 20.0, 20.3 and 21.0 the second is within the deadband of the first, and is not sent."""

    async def work() -> None:
        port = free_port()
        server = await served(port)
        sources = {VARIABLE: hg.files.json_field("value", "boiler", time="source_time")}
        where = parse_address(f"opc.tcp://127.0.0.1:{port}/plant", {})
        transport = make_transport(where, translator=Translator(sources, network()))
        try:
            variable = server.get_node(VARIABLE)
            stated = await asyncio.to_thread(read_reporting, f"opc.tcp://127.0.0.1:{port}/plant", [VARIABLE])
            assert stated == {VARIABLE: Reporting(0.5, 0.1)}
            values = []
            for value in (None, 20.3, 21.0):
                if value is not None:
                    await variable.write_value(value)
                if value == 20.3:
                    await asyncio.sleep(0.3)  # three of the server's sampling intervals
                else:
                    batch = await asyncio.wait_for(transport.receive(), 30)
                    values += [message.values[0] for message in batch.payloads]
            assert values == [20.0, 21.0] and transport.reporting == {VARIABLE: Reporting(0.5, 0.1)}
        finally:
            await transport.close()
            await stopped(server)

    asyncio.run(work())


@pytest.mark.real("OPC UA")
def test_a_deadband_in_percent_is_one_in_the_variables_unit():
    async def work() -> None:
        port = free_port()
        server = await served(port, percent=True)
        try:
            result = await asyncio.to_thread(read_reporting, f"opc.tcp://127.0.0.1:{port}/plant", [VARIABLE])
            assert result == {VARIABLE: Reporting(0.5, 0.1)}
        finally:
            await stopped(server)

    asyncio.run(work())


@pytest.mark.real("OPC UA")
def test_a_server_that_starts_again_is_subscribed_again():
    """Its variable's value of then comes, as a stored message whose source dates it."""

    async def work() -> None:
        port = free_port()
        server = await served(port)
        sources = {VARIABLE: hg.files.json_field("value", "boiler", time="source_time")}
        where = parse_address(f"opc.tcp://127.0.0.1:{port}/plant", {})
        transport = make_transport(where, translator=Translator(sources, network()))
        try:
            (first,) = (await asyncio.wait_for(transport.receive(), 30)).payloads
            await stopped(server)
            server = await served(port)
            await server.get_node(VARIABLE).write_value(25.0)
            (second,) = (await asyncio.wait_for(transport.receive(), 60)).payloads
            assert (first.values, second.values) == ([20.0], [25.0]) and second.time > first.time
        finally:
            await transport.close()
            await stopped(server)

    asyncio.run(work())


@pytest.mark.real("OPC UA")
def test_a_change_is_a_step_of_a_node_whose_sender_has_the_deadband():
    """Changes of a variable are dated; a network with a trigger counts steps, here of the sampling interval."""

    async def work() -> None:
        port = free_port()
        server = await served(port)
        url = f"opc.tcp://127.0.0.1:{port}/plant"
        rule = (await asyncio.to_thread(read_reporting, url, [VARIABLE]))[VARIABLE]
        plant, sensor = hg.LinearPlant([[1.0]], 0.01, [20.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
        trigger = rule.trigger()
        item = hg.event_filter(plant, sensor, hg.perfect(), trigger)
        net = hg.Network(plant, {"boiler": hg.Node(sensor, hg.perfect(), {"f": item}, trigger=trigger)})
        field = hg.files.json_field("value", "boiler", time="source_time", step=rule.interval)
        translator = Translator({VARIABLE: field}, net)
        fleet = Fleet(NetworkProgram(net), Options(window=20.0, step=translator.sources.step_seconds))
        service, transport = (
            Service(fleet, InMemoryStore()),
            make_transport(parse_address(url, {}), translator=translator),
        )
        try:
            outputs = service.take((await asyncio.wait_for(transport.receive(), 30)).payloads)
            await asyncio.sleep(1.0)
            await server.get_node(VARIABLE).write_value(21.0)
            outputs = service.take((await asyncio.wait_for(transport.receive(), 30)).payloads)
            newest = json.loads(outputs[-1].body)
            assert newest["kind"] == "provisional" and newest["senders"]["boiler"]["last"] >= 9
            assert abs(newest["estimates"]["boiler"]["f"]["mean"][0] - 21.0) < 0.3
        finally:
            await transport.close()
            await stopped(server)

    asyncio.run(work())


@pytest.mark.real("OPC UA")
def test_inspect_lists_the_variables_of_a_server_and_suggests_sources():
    """Five changes a second while it listens, all beyond the deadband; properties are no topics."""

    async def changed(server: Server) -> None:
        for value in range(21, 200):
            await asyncio.sleep(0.2)
            await server.get_node(VARIABLE).write_value(float(value))

    async def work() -> dict:
        port = free_port()
        server = await served(port)
        changes = asyncio.create_task(changed(server))
        try:
            return await asyncio.to_thread(listen, parse_address(f"opc.tcp://127.0.0.1:{port}/plant", {}), 2.0)
        finally:
            changes.cancel()
            await stopped(server)

    topics = asyncio.run(work())
    assert list(topics) == [VARIABLE] and topics[VARIABLE].kind == "Double, deadband 0.5, 0.1 s"
    count, rate, _, late = topics[VARIABLE].format_row()[1:]
    assert int(count) >= 4 and 2.5 < float(rate.removesuffix(" Hz")) < 7.5  # five a second, on a busy machine
    assert 0 <= float(late.split()[0]) < 1.0
    line = f"    {VARIABLE!r}: hg.files.json_field('value', node='NODE', output='OUTPUT', time='source_time'),"
    assert suggest_sources(topics, {}).splitlines() == ["sources = {", line, "}"]


@pytest.mark.real("OPC UA")
def test_no_server_is_one_line():
    with pytest.raises(hg.InputError, match=r"^OPC UA server opc\.tcp://127\.0\.0\.1:\d+/: expected an answer, got "):
        read_reporting(f"opc.tcp://127.0.0.1:{free_port()}", [VARIABLE])
