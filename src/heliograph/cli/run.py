"""`heliograph run`: the filters of a network over measured data."""

import sys
from pathlib import Path
from typing import Annotated

import heliograph
from heliograph.cli.app import place


def run(
    network: str,
    /,
    *,
    measurements: Annotated[Path, place("CSV or Parquet: time, inputs and received measurements.")],
    out: Annotated[Path, place("CSV or Parquet to write: estimates with their claimed covariances.")],
) -> None:
    """Run the filters of your own network over measured data.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.files.quoting import visible
    from heliograph.files.table import check_output
    from heliograph.numerics.check import fail
    from heliograph.report.progress import progress

    check_output(out)
    if out.resolve() == measurements.resolve():
        raise fail(f"output file {out}", "another file than the measurements", "the same")
    with progress(3) as advance:
        advance("starting")
        from heliograph.files.network_file import load_network
        from heliograph.files.recording import read_recording, write_estimates

        loaded = load_network(network)
        if not any(node.filters for node in loaded.nodes.values()):
            raise fail(f"network {network}", "at least one filter to run", "none")
        recording = read_recording(measurements, loaded)
        advance(f"filtering {len(recording.time)} rows")
        record = heliograph.run(loaded, *recording)
        advance(f"writing {out}")
        write_estimates(record, out)
    for failure in record.failures():
        print(f"heliograph: warning: {visible(failure)}", file=sys.stderr)
    filters = [
        f"{node}/{name} ({estimate.claim})"
        for node, estimates in record.estimates.items()
        for name, estimate in estimates.items()
    ]
    print(visible(f"{out}: {len(record.time)} rows of {', '.join(filters)}"))
