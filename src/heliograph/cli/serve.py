"""`heliograph serve`: the filters of a network kept running, from messages to estimates."""

from typing import Annotated

from cyclopts import Parameter


def serve(
    network: str | None = None,
    /,
    *,
    window: Annotated[float, Parameter(help="How late a message may be, in seconds or steps.")] = 10.0,
    ahead: Annotated[float, Parameter(help="How much later than its arrival a message's time may be.")] = 0.0,
    leap: Annotated[float | None, Parameter(help="How much later than all before it; any, unless given.")] = None,
    store: Annotated[
        str | None,
        Parameter(
            help="File or PostgreSQL URL that keeps the state: NETWORK.db here, unless given; none keeps nothing."
        ),
    ] = None,
    process: Annotated[str, Parameter(help="Name of this process among several that share a store.")] = "",
    from_snapshot: Annotated[
        str | None, Parameter(help="File or PostgreSQL URL of a store whose plants this one begins with.")
    ] = None,
    anew: Annotated[
        list[str] | None,
        Parameter(help="Name of a plant whose state is forgotten at the start; may be given again.", negative=""),
    ] = None,
    accept_changes: Annotated[
        bool, Parameter(help="Go on from a store whose network has changed, with all that fits.", negative="")
    ] = False,
    broker: Annotated[str | None, Parameter(help="mqtt:// or nats://host:port/topic, or opc.tcp://host:port.")] = None,
    parts: Annotated[int | None, Parameter(help="Parts of the plants that processes share among them.")] = None,
    node: Annotated[
        str | None,
        Parameter(help="Node of a fusion between neighbours that this process is; its messages go by the broker."),
    ] = None,
    page: Annotated[str | None, Parameter(help="Port of a page to watch it on, or address:port.")] = None,
    schema: Annotated[bool, Parameter(help="Print the JSON schema of messages and outputs.", negative="")] = False,
) -> None:
    """Keep the filters of your own network running: messages as JSON lines in, estimates as JSON lines out.

    Where the network's file names `sources`, messages of their topics are read too: of the broker, or of lines with a
    topic and a payload, as mosquitto_sub -F %j prints them.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several.
    """
    import asyncio
    import json

    from heliograph.files.network_file import load_module
    from heliograph.live.fleet import Options
    from heliograph.numerics.check import fail
    from heliograph.serving.brokers.url import address
    from heliograph.serving.message import schema as message_schema
    from heliograph.serving.output import schema as output_schema
    from heliograph.serving.running import ServiceSettings, name_of, of_node, run, store_of

    # The schema needs no network.
    if schema:
        print(json.dumps({"message": message_schema(), "output": output_schema()}, indent=1))
        return
    if network is None:
        raise fail("serve", "a network, such as my_network.py", "none")
    # Settings of the service; it then runs until its messages end.
    where = None if broker is None else address(broker)
    options = Options(window, ahead, float("inf") if leap is None else leap)
    opened = store_of(network, store, parts, node)
    loaded, module = load_module(network)
    settings = ServiceSettings(
        loaded,
        options,
        opened,
        process,
        from_snapshot,
        where,
        parts,
        page,
        tuple(anew or ()),
        module.get("sources"),
        name_of(network),
        accept_changes,
    )
    asyncio.run(run(settings if node is None else of_node(settings, node)))
