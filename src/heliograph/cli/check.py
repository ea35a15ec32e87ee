"""`heliograph check`: a network as a diagram, what is doubtful in it before data, and what its sensors are worth."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from heliograph.cli.app_and_option_types import path_option
from heliograph.cli.sensor_worth import WorthOptions, compute_worth, describe_worth, write_worth_figure

DOUBTFUL = 1


def check(
    network: str,
    /,
    *,
    without: Annotated[list[str] | None, Parameter(help="Node to leave out, or each; may be repeated.")] = None,
    outage: Annotated[
        list[str] | None, Parameter(help="NODE:STEPS, out at the end of the run; may be repeated.")
    ] = None,
    added: Annotated[
        list[str] | None, Parameter(name="--with", help="Node of the file to try too, or a dictionary of nodes.")
    ] = None,
    figure: Annotated[Path | None, path_option("SVG or PNG file for a figure of what sensors are worth.")] = None,
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

    With --without, --outage or --with also what sensors are worth: the error of one filter of all nodes at the end of a
    run, with a node left out of all of it or of its last steps, or with one more, such as one sensor at several places;
    how many times that of all nodes it is, and which addition is best. The error is the covariance where that filter's
    claim is exact, else the root mean square of the runs' errors; the table and the figure say which.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.disk.quoted_text import visible
    from heliograph.files.network_file import load_module
    from heliograph.numerics.check import fail
    from heliograph.simulation.description.doubts import doubts_before_data

    # What is asked of sensors is computed first, so that bad input prints nothing.
    loaded, module = load_module(network)
    options = WorthOptions(without or [], outage or [], added or [], inputs or [], steps, runs, figure)
    if figure is not None and not options.is_asked:
        raise fail("--figure", "what sensors are worth (--without, --outage or --with)", "none of these")
    worth = compute_worth(loaded, module, options) if options.is_asked else None
    # The diagram, then a line for each doubt, of which only the serious ones count.
    print("\n".join(map(visible, loaded.diagram().splitlines())))
    doubts = doubts_before_data(loaded)
    print()
    for doubt in doubts:
        print(visible(f"{'doubtful' if doubt.serious else 'note'}: {doubt.words}"))
    serious = sum(doubt.serious for doubt in doubts)
    print(f"{serious} doubtful" if serious else "nothing doubtful")
    if worth is not None:
        print()
        for row in describe_worth(worth, steps, runs):
            print(visible(row))
        write_worth_figure(worth, options)
    return DOUBTFUL if serious else 0
