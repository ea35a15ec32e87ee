"""`heliograph serve`: the filters of a network kept running, from messages to estimates."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from heliograph.cli.app import place

if TYPE_CHECKING:
    from heliograph.serving.fleet import Fleet
    from heliograph.serving.keeping import Keeps


def serve(
    network: str | None = None,
    /,
    *,
    window: Annotated[float, Parameter(help="How late a message may be, in seconds or steps.")] = 10.0,
    ahead: Annotated[float, Parameter(help="How much later than its arrival a message's time may be.")] = 0.0,
    leap: Annotated[float | None, Parameter(help="How much later than all before it; any, unless given.")] = None,
    store: Annotated[str | None, Parameter(help="File or PostgreSQL URL that keeps the state.")] = (None),
    process: Annotated[str, Parameter(help="Name of this process among several that share a store.")] = "",
    from_snapshot: Annotated[Path | None, place("Store of which to begin from the plants.")] = None,
    schema: Annotated[bool, Parameter(help="Print the JSON schema of messages and outputs.", negative="")] = False,
) -> None:
    """Keep the filters of your own network running: messages as JSON lines in, estimates as JSON lines out.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several.
    """
    import asyncio
    import json

    from heliograph.files.network_file import load_network
    from heliograph.numerics.check import fail
    from heliograph.serving.fleet import Fleet, Options
    from heliograph.serving.lanes import Lanes
    from heliograph.serving.loop import keep_running
    from heliograph.serving.message import schema as message_schema
    from heliograph.serving.output import schema as output_schema
    from heliograph.serving.pipe import Pipe
    from heliograph.serving.service import Service

    if schema:
        print(json.dumps({"message": message_schema(), "output": output_schema()}, indent=1))
        return
    if network is None:
        raise fail("serve", "a network, such as my_network.py", "none")
    lanes = Lanes(load_network(network))
    if lanes.uneven:
        print(f"heliograph: warning: predictions depend on when others are asked for: {lanes.uneven}", file=sys.stderr)
    fleet = Fleet(lanes, Options(window, ahead, float("inf") if leap is None else leap))
    kept = _kept(fleet, store, process, from_snapshot)
    try:
        asyncio.run(keep_running(Service(fleet, kept), Pipe()))
    finally:
        kept.close()


def _kept(fleet: "Fleet", store: str | None, process: str, snapshot: Path | None) -> "Keeps":
    """Where the state is kept, with what it begins from."""
    from heliograph.numerics.check import fail
    from heliograph.serving.identity import identity
    from heliograph.serving.nowhere import Nowhere
    from heliograph.serving.store import Store

    if store is None:
        if snapshot is not None:
            raise fail("--from-snapshot", "a store to begin in (--store FILE)", "none")
        return Nowhere()
    mine = identity(fleet)
    kept = Store(store, mine, process)
    if snapshot is not None:
        if not snapshot.is_file():
            raise fail(f"snapshot {snapshot}", "a store's file", "nothing of that name")
        kept.begin_from(str(snapshot), mine)
    return kept
