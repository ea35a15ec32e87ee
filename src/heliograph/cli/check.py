"""`heliograph check`: a network as a diagram, what is doubtful in it before data, and what its sensors are worth."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    import numpy as np

    from heliograph.planning.sensors import SensorWorth
    from heliograph.simulation.network import Network

DOUBTFUL = 1
EACH = "each"


def check(
    network: str,
    /,
    *,
    without: Annotated[list[str] | None, Parameter(help="Node to leave out, or each; may be repeated.")] = None,
    outage: Annotated[
        list[str] | None, Parameter(help="NODE:STEPS, out at the end of the run; may be repeated.")
    ] = None,
    inputs: Annotated[
        list[str] | None, Parameter(name="--input", help="NAME=VALUE of an input, the same in all steps.")
    ] = None,
    steps: Annotated[int, Parameter(help="Length of a run, for what is left out.")] = 200,
    runs: Annotated[int, Parameter(help="Number of runs.")] = 200,
) -> int:
    """Show your own network as a diagram, and what is doubtful in it before any data.

    Judged are states that no sensor shows, errors that grow without end, memory of links that a filter ignores, what
    links share, what native code does not take, such as a filter of your own, with the line, and which filters go row
    by row however long a recording is. The exit status is 0 where nothing is doubtful, 1 where something is, and 2 for
    bad input.

    With --without or --outage also what sensors are worth: the error of one filter of all nodes at the end of a run,
    with a node left out of all of it or of its last steps, and how many times that of all nodes it is.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.disk.quoting import visible
    from heliograph.files.network_file import load_network
    from heliograph.simulation.description.doubts import doubts_before_data

    # What is asked of sensors is computed first, so that bad input prints nothing.
    loaded = load_network(network)
    worth = None
    if without or outage:
        worth = _compute_worth(loaded, without or [], outage or [], inputs or [], steps, runs)
    # The diagram, then a line for each doubt.
    print("\n".join(map(visible, loaded.diagram().splitlines())))
    lines = doubts_before_data(loaded)
    print()
    for line in lines:
        print(visible(f"{'doubtful' if line.serious else 'note'}: {line.words}"))
    serious = sum(line.serious for line in lines)
    print(f"{serious} doubtful" if serious else "nothing doubtful")
    if worth is not None:
        print()
        for row in _describe_worth(worth, steps, runs):
            print(visible(row))
    return DOUBTFUL if serious else 0


def _compute_worth(
    network: "Network", without: Sequence[str], outage: Sequence[str], inputs: Sequence[str], steps: int, runs: int
) -> "SensorWorth":
    """Return what sensors are worth, from the options as they are typed."""
    import heliograph as hg
    from heliograph.numerics.check import fail

    outages = {}
    for word in outage:
        name, _, count = word.rpartition(":")
        if not name or not (count.isascii() and count.isdecimal()):
            raise fail("--outage", "NODE:STEPS, such as gnss:60", repr(word))
        outages[name] = int(count)
    names = list(network.nodes) if EACH in without and EACH not in network.nodes else list(without)
    values = _read_inputs(network.inputs, inputs, steps)
    worth: SensorWorth = hg.planning.worth_of_sensors(network, steps, names, outages, runs=runs, inputs=values)
    return worth


def _read_inputs(names: Sequence[str], words: Sequence[str], steps: int) -> "np.ndarray | None":
    """Return the inputs of all steps (steps, inputs) from a word NAME=VALUE for each; None of a plant without any."""
    import numpy as np

    from heliograph.numerics.check import fail

    values = {}
    for word in words:
        name, _, number = word.partition("=")
        try:
            values[name] = float(number)
        except ValueError:
            raise fail("--input", "NAME=VALUE, such as dt=0.5", repr(word)) from None
    if set(values) != set(map(str, names)):
        raise fail("--input", f"one of each input of the plant, {list(names)}", sorted(values))
    return np.tile([values[str(name)] for name in names], (steps, 1)) if names else None


def _describe_worth(worth: "SensorWorth", steps: int, runs: int) -> Iterator[str]:
    """Yield the lines of the table: a title, the states, then a line for each case, that of all nodes first."""
    how = "by the covariance" if worth.exact else f"root mean square of {runs} runs"
    yield f"error of one filter of all nodes after {steps} steps, {how} (and times that of all nodes)"
    cases = [worth.complete, *worth.cases]
    width = max(len(case.name) for case in cases)
    yield "  ".join([" " * width, *(f"{name:>20}" for name in worth.states)])
    for case in cases:
        cells = [f"{e:.4g} ({times:.3g})" for e, times in zip(case.error, case.increase, strict=True)]
        yield "  ".join([f"{case.name:<{width}}", *(f"{cell:>20}" for cell in cells)])
