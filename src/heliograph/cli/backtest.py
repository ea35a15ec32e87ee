"""`heliograph backtest`: forecasts from each row of a recording, against what came."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import heliograph
from heliograph.cli.app import folder, measured_option, path_option
from heliograph.cli.reading import ReadingOptions, read_measured
from heliograph.files.stores.address import StoreAddress

if TYPE_CHECKING:
    from heliograph.report.progress import Advance
    from heliograph.report.results import Results

NAME = "backtest"


def backtest(
    network: str,
    /,
    *,
    measurements: Annotated[Path | StoreAddress, measured_option()],
    out: Annotated[Path, path_option("Folder for the page and its figure; made if missing.")],
    horizons: Annotated[str, Parameter(help="Rows ahead, as 1,3,12.")] = "1,2,5,10",
    skip: Annotated[int, Parameter(help="Rows at the start from which nothing is forecast.")] = 10,
    reading: ReadingOptions | None = None,
) -> None:
    """Forecast from each row of measured data, and score what was said against what came.

    By horizon: error, coverage of 50, 80 and 95 %, log score and CRPS, with standard errors that know the overlap.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several.
    """
    from heliograph.disk.quoting import visible
    from heliograph.numerics.check import fail
    from heliograph.numerics.times.dates import horizons_in
    from heliograph.report.results import write_results

    # Check the options before anything is computed.
    target, asked = folder("backtest", out, NAME) / NAME, horizons_in(horizons)
    listed = [asked] if isinstance(asked, int) else asked
    ahead = [horizon for horizon in listed if isinstance(horizon, int)]
    if len(ahead) < len(listed):
        raise fail("--horizons", "numbers of rows, as 1,3,12", horizons)

    def compute(advance: "Advance") -> "heliograph.forecasting.Backtest":
        from heliograph.files.network_file import load_module

        advance("reading")
        loaded, module = load_module(network)
        (data, *others) = read_measured(measurements, network, loaded, module, reading or ReadingOptions(), advance)
        if others:
            raise fail("backtest", "data of one plant (--plant NAME)", f"{len(others) + 1} plants")
        advance(f"forecasting from {len(data.recording.time)} rows")
        z, u, time, truth = data.recording
        return heliograph.backtest(loaded, z, ahead, u, time, truth, skip)

    def results(found: "heliograph.forecasting.Backtest") -> "Results":
        from heliograph.report.pages.backtest import make_backtest_results

        return make_backtest_results(found, network)

    found = write_results(target, 3, compute, results)
    for score in found.scores:
        shares = ", ".join(f"{share.value:.1%} +- {share.error:.1%}" for share in score.coverage)
        print(visible(f"{score.node}/{score.filter} {score.part} {score.name}, {score.horizon} ahead: within the "
                      f"intervals of 50, 80, 95 %: {shares}"))  # fmt: skip
    print(visible(str(target / "report.html")))
