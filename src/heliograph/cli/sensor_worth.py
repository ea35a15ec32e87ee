"""What sensors are worth, for `heliograph check`: options read, the table printed, the figure written."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from heliograph.planning.sensor_worth import SensorWorth
    from heliograph.simulation.network import Network
    from heliograph.simulation.node import Node

EACH = "each"
FIGURES = (".svg", ".png")


@dataclass(frozen=True)
class WorthOptions:
    """What is asked of sensors, as it is typed.

    Args:
        without: nodes to leave out, or "each".
        outage: NODE:STEPS, out at the end of the run.
        added: names in the network's file, of nodes to try or of dictionaries of nodes.
        inputs: NAME=VALUE of each input of the plant.
        steps: length of a run.
        runs: number of runs.
        figure: file of the figure; None for none.
    """

    without: Sequence[str]
    outage: Sequence[str]
    added: Sequence[str]
    inputs: Sequence[str]
    steps: int
    runs: int
    figure: Path | None

    @property
    def is_asked(self) -> bool:
        """Return whether a case is asked for: a node to leave out, an outage, or a node to try."""
        return bool(self.without or self.outage or self.added)


def compute_worth(network: "Network", module: Mapping[str, object], options: WorthOptions) -> "SensorWorth":
    """Return what sensors are worth.

    A sensor's worth is how much larger the estimates' errors are without it, or while it is out, or how much smaller
    with a new one.

    Args:
        network: the network.
        module: names defined in the network's file, among them those of nodes to try.
        options: options as they are typed: which nodes are left out, out for some steps, or added.

    Raises:
        ValueError: an option that cannot be read, a figure that cannot be written, what `worth_of_sensors` refuses.
    """
    import heliograph as hg
    from heliograph.numerics.check import fail

    # Outages NODE:STEPS as {node: steps}.
    outages = {}
    for word in options.outage:
        name, _, count = word.rpartition(":")
        if not name or not (count.isascii() and count.isdecimal()):
            raise fail("--outage", "NODE:STEPS, such as gnss:60", repr(word))
        outages[name] = int(count)
    # "each" is all nodes, one after another, unless a node has that name.
    is_each = EACH in options.without and EACH not in network.nodes
    if options.figure is not None:
        _check_figure_writable(options.figure)
    worth: SensorWorth = hg.planning.worth_of_sensors(
        network,
        options.steps,
        list(network.nodes) if is_each else list(options.without),
        outages,
        _find_nodes(module, options.added),
        runs=options.runs,
        inputs=_parse_inputs(network.inputs, options.inputs, options.steps),
    )
    return worth


def _check_figure_writable(figure: Path) -> None:
    """Raise ValueError, or MissingPackagesError, before the work starts if a figure could not be written after it.

    Its format or folder may be wrong, or matplotlib not installed.
    """
    from heliograph.disk.atomic_files import check_writable
    from heliograph.numerics.process.optional_packages import check_installed

    check_installed(["matplotlib"])
    check_writable(figure, FIGURES)


def _find_nodes(module: Mapping[str, object], names: Sequence[str]) -> dict[str, "Node"]:
    """Return the nodes that these names of the network's file stand for, by name, as --with adds them.

    A name is that of a node, or of a dictionary of nodes, which counts as all of these. `module` has what the file
    defines.

    Raises:
        ValueError: a name that the file does not define or that is something else; two nodes of the same name.
    """
    from difflib import get_close_matches

    from heliograph.numerics.check import fail, show_value
    from heliograph.simulation.node import Node

    found = dict[str, Node]()
    for name in names:
        value = module.get(name)
        given = value if isinstance(value, Mapping) else {name: value}
        nodes = {str(key): node for key, node in given.items() if isinstance(node, Node)}
        if name not in module or not nodes or len(nodes) < len(given):
            close = get_close_matches(name, [key for key in module if not key.startswith("_")], 1)
            hint = f" (closest: {close[0]!r})" if close else ""
            got = show_value(value) if name in module else f"no such name{hint}"
            raise fail(f"--with {name}", "a heliograph.Node of the network's file, or a dictionary of nodes", got)
        if taken := [key for key in nodes if key in found]:
            raise fail("--with", "nodes of different names", f"{taken[0]!r} twice")
        found |= nodes
    return found


def _parse_inputs(names: Sequence[str], words: Sequence[str], steps: int) -> "np.ndarray | None":
    """Return the inputs of all steps (steps, inputs) from the words of --input, NAME=VALUE for each input.

    An input has the same value in all steps. None is returned for a plant without inputs.

    Raises:
        ValueError: a word that cannot be read, or not one word for each of the plant's inputs (`names`).
    """
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


def describe_worth(worth: "SensorWorth", steps: int, runs: int) -> Iterator[str]:
    """Yield the lines of the table: a title, the states, a line for each case, and the best addition if any.

    Args:
        worth: what `compute_worth` returned.
        steps: length of a run.
        runs: number of runs.
    """
    yield f"error of one filter of all nodes after {steps} steps, {worth.describe_method(runs)} (and times that of all)"
    cases = [worth.complete, *worth.cases]
    width = max(len(case.name) for case in cases)
    yield "  ".join([" " * width, *(f"{name:>20}" for name in worth.states)])
    for case in cases:
        cells = [f"{error:.4g} ({times:.3g})" for error, times in zip(case.error, case.increase, strict=True)]
        yield "  ".join([f"{case.name:<{width}}", *(f"{cell:>20}" for cell in cells)])
    best = worth.best_addition
    if best is not None:
        yield f"best addition: {best.name}, {best.mean_increase:.3g} times the error (geometric mean over states)"


def write_worth_figure(worth: "SensorWorth", options: WorthOptions) -> None:
    """Write the figure of what sensors are worth, if one is asked for."""
    if options.figure is None:
        return
    from heliograph.disk.atomic_files import whole_file
    from heliograph.report.figures import png, svg
    from heliograph.report.pages.sensor_worth import draw_worth

    figure = draw_worth(worth, f"error after {options.steps} steps, {worth.describe_method(options.runs)}")
    with whole_file(options.figure) as partial_file:
        is_png = options.figure.suffix.lower() == ".png"
        partial_file.write_bytes(png(figure) if is_png else svg(figure))
