"""`heliograph export`: one step of a network's filter as C, for a device."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from heliograph.cli.app_and_option_types import path_option

if TYPE_CHECKING:
    from heliograph.export.c_files import Exported, StepCost


def export(
    network: str,
    /,
    *,
    filter: Annotated[str, Parameter(help="Name of the filter, or of a fusion.")],
    out: Annotated[Path, path_option("The source to write, such as step.c; step.h is written beside it.")],
    node: Annotated[
        str | None, Parameter(help="Node that has it, fused for the centre; needed where several do.")
    ] = None,
    precision: Annotated[str, Parameter(help="double, or float: single precision.")] = "double",
    apart: Annotated[bool, Parameter(help="Prediction, correction and a start as functions of their own too.")] = False,
    size: Annotated[bool, Parameter(help="Small rather than fast: points one after another, in loops.")] = False,
    window: Annotated[
        int | None, Parameter(help="How many steps late a measurement may be; none is late unless given.")
    ] = None,
) -> None:
    """Write one step of a filter of your own network as C99, for a device: no heap, no library but libm.

    All names in the files begin with the name of the file. Printed are bytes, operations and the time of a step.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.disk.quoted_text import visible
    from heliograph.export.c_files import PRECISIONS, check_source_path, measure_step_cost, write_filter_files
    from heliograph.export.c_text import find_claim_at_precision
    from heliograph.export.received_numbers import Received
    from heliograph.files.network_file import load_network
    from heliograph.simulation.centres.named_filter import find_filter_by_name

    # Refuse a bad path before the network is loaded.
    check_source_path(out)
    named = find_filter_by_name(load_network(network), filter, node)
    # Write the files, then compile and time them.
    received = Received(named.received, named.refused_values, named.leave_out_refused, named.looks_for_stuck)
    written = write_filter_files(named.filter, received, out, precision, apart, size, window)
    exported, real = named.filter, PRECISIONS[precision]
    measured = measure_step_cost(written.header, written.source, exported.received, len(exported.inputs), real)
    claim = find_claim_at_precision(exported, real)
    print(visible(f"{written.header}, {written.source}: {named.place}/{filter} ({claim}), {precision} precision"))
    print("\n".join(describe_costs(written, measured)))


KINDS = {
    "additions": ("add", "sub", "neg"),
    "multiplications": ("mul",),
    "divisions": ("div",),
    "roots": ("sqrt",),
    "choices": ("select", "max", "min"),
}


def describe_costs(written: "Exported", measured: "StepCost") -> list[str]:
    """Return two lines on the cost of a step: its operations by kind; bytes of state and code, and its time.

    KINDS: the operations of each kind that is named; what could not be measured is None.
    """
    from heliograph.export.c_files import COMPILER

    total = sum(written.operations.values())
    counts = {
        kind: sum(written.operations.get(operation, 0) for operation in operations)
        for kind, operations in KINDS.items()
    }
    counts["others"] = total - sum(counts.values())
    by_kind = ", ".join(f"{count:,} {kind}" for kind, count in counts.items() if count)
    state = f"state {written.state_bytes:,} bytes"
    code = "code unmeasured" if measured.code_bytes is None else f"code {measured.code_bytes:,} bytes"
    time = f"time unmeasured: no C compiler {COMPILER!r} here"
    if measured.nanoseconds is not None:
        time = f"a step {measured.nanoseconds:,.0f} ns ({COMPILER} -O2 on this machine)"
    return [f"{total:,} operations: {by_kind}", f"{state}, {code}, {time}"]
