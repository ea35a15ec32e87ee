"""`heliograph export`: one step of a network's filter as C, for a device."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from heliograph.cli.app import path_option

if TYPE_CHECKING:
    from heliograph.export.c_files import Cost, Exported
    from heliograph.simulation.network import Network


def export(
    network: str,
    /,
    *,
    filter: Annotated[str, Parameter(help="Name of the filter.")],
    out: Annotated[Path, path_option("The source to write, such as step.c; step.h is written beside it.")],
    node: Annotated[str | None, Parameter(help="Node that has it; needed where several do.")] = None,
    precision: Annotated[str, Parameter(help="double, or float: single precision.")] = "double",
) -> None:
    """Write one step of a filter of your own network as C99, for a device: no heap, no library but libm.

    All names in the files begin with the name of the file. Printed are bytes, operations and the time of a step.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.disk.quoting import visible
    from heliograph.export.c_files import PRECISIONS, check_place, export_named, measure_cost
    from heliograph.export.text import claim_of
    from heliograph.files.network_file import load_network

    # Refuse a bad path before the network is loaded.
    check_place(out)
    loaded = load_network(network)
    chosen = find_node(loaded, filter, node)
    subject = loaded.nodes[chosen].filters[filter]
    names = loaded.nodes[chosen].received_names[: subject.received]
    # Write the files, then compile and time them.
    written = export_named(subject, out, precision, names)
    measured = measure_cost(
        written.header, written.source, subject.received, len(subject.inputs), PRECISIONS[precision]
    )
    claim = claim_of(subject, PRECISIONS[precision])
    print(visible(f"{written.header}, {written.source}: {chosen}/{filter} ({claim}), {precision} precision"))
    print("\n".join(describe_costs(written, measured)))


def find_node(network: "Network", filter_name: str, node: str | None) -> str:
    """Return the node that has the filter."""
    from heliograph.numerics.check import fail

    having = [name for name in network.names if filter_name in network.nodes[name].filters]
    if not having:
        known = sorted({name for of_node in network.nodes.values() for name in of_node.filters})
        raise fail("--filter", f"one of the network's filters {known}", repr(filter_name))
    if node is None and len(having) > 1:
        raise fail("--node", f"one of {having}, which all have a filter {filter_name!r}", "none")
    if node is not None and node not in having:
        raise fail("--node", f"one that has a filter {filter_name!r} {having}", repr(node))
    return having[0] if node is None else node


KINDS = {
    "additions": ("add", "sub", "neg"),
    "multiplications": ("mul",),
    "divisions": ("div",),
    "roots": ("sqrt",),
    "choices": ("select", "max", "min"),
}


def describe_costs(written: "Exported", measured: "Cost") -> list[str]:
    """Describe the cost of a step in two lines."""
    from heliograph.export.c_files import COMPILER

    counts = {kind: sum(written.operations.get(op, 0) for op in ops) for kind, ops in KINDS.items()}
    counts["others"] = sum(written.operations.values()) - sum(counts.values())
    parts = ", ".join(f"{count:,} {kind}" for kind, count in counts.items() if count)
    state = f"state {written.state_bytes:,} bytes"
    code = "code unmeasured" if measured.code_bytes is None else f"code {measured.code_bytes:,} bytes"
    time = (
        f"time unmeasured: no C compiler {COMPILER!r} here"
        if measured.nanoseconds is None
        else f"a step {measured.nanoseconds:,.0f} ns ({COMPILER} -O2 on this machine)"
    )
    return [f"{sum(written.operations.values()):,} operations: {parts}", f"{state}, {code}, {time}"]
