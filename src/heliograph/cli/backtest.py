"""`heliograph backtest`: forecasts from each row of a recording, against what came."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import heliograph
from heliograph.cli.app_and_option_types import choose_results_folder, integer_option, measured_option, path_option
from heliograph.cli.measured_data import ReadingOptions, read_measured_plants
from heliograph.files.stores.store_address import StoreAddress

if TYPE_CHECKING:
    from collections.abc import Callable

    from heliograph.files.recordings.recording import Recording
    from heliograph.report.progress import Advance
    from heliograph.report.results_folder import ResultsContent
    from heliograph.simulation.network import Network

NAME = "backtest"
STAGES = 3  # of the progress bar: reading the network, reading the data, forecasting
STAGES_WITH_REFIT = STAGES + 1  # fitting too


def backtest(
    network: str,
    /,
    *,
    measurements: Annotated[Path | StoreAddress, measured_option()],
    out: Annotated[Path, path_option("Folder for the page and its figure; made if missing.")],
    horizons: Annotated[str, Parameter(help="Rows ahead, as 1,3,12.")] = "1,2,5,10",
    skip: Annotated[int, Parameter(help="Rows at the start from which nothing is forecast.")] = 10,
    refit: Annotated[
        int,
        integer_option(
            "Rows between fits of the free numbers to the rows before; 0: the numbers of the file throughout."
        ),
    ] = 0,
    reading: ReadingOptions | None = None,
) -> None:
    """Forecast from each row of measured data, and score what was said against what came.

    With --refit, each row is forecast by a network whose free numbers (hg.free) were fitted to rows before it.
    By horizon: error, coverage of 50, 80 and 95 %, log score and CRPS, with standard errors that know the overlap.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several.
    """
    from heliograph.disk.quoted_text import visible
    from heliograph.numerics.check import check_count, fail
    from heliograph.report.results_folder import write_results

    # Check the options before anything is computed.
    target = _choose_target(network, measurements, out)
    rows_ahead = _parse_rows_ahead(horizons)
    check_count("--refit", refit, 0)
    check_count("--skip", skip, 1 if refit else 0)

    def compute(advance: "Advance") -> "heliograph.forecasting.Backtest":
        """Read the data of one plant, and forecast `rows_ahead` from its rows, by the options of the command line."""
        from heliograph.files.network_file import load_module

        advance("reading")
        loaded, module = load_module(network)
        (data, *others) = read_measured_plants(
            measurements, network, loaded, module, reading or ReadingOptions(), advance
        )
        if others:
            raise fail("backtest", "data of one plant (--plant NAME)", f"{len(others) + 1} plants")
        advance(f"forecasting from {len(data.recording.time)} rows")
        z, u, time, truth = data.recording
        fit_to_first = _make_refit(network, data.recording, advance) if refit else None
        # Without a refit `every` is not used.
        return heliograph.backtest(
            loaded, z, rows_ahead, inputs=u, time=time, truth=truth, skip=skip, refit=fit_to_first, every=refit or 1
        )

    def make_results(found: "heliograph.forecasting.Backtest") -> "ResultsContent":
        """Return the content of the results folder; the network is fitted anew each `refit` rows, 0 for never."""
        from heliograph.report.pages.backtest import make_backtest_results

        return make_backtest_results(found, network, refit)

    found = write_results(target, STAGES_WITH_REFIT if refit else STAGES, compute, make_results)
    for score in found.scores:
        print(visible(_describe_coverage(score)))
    print(visible(str(target / "report.html")))


def _choose_target(network: str, measurements: Path | StoreAddress, out: Path) -> Path:
    """Return the folder of the results in `out`; raise ValueError if it holds a file that is read."""
    from heliograph.disk.kept_inputs import find_network_file, refuse_replacing

    target = choose_results_folder("backtest", out, NAME) / NAME
    refuse_replacing([measurements, find_network_file(network)], [], target)
    return target


def _parse_rows_ahead(horizons: str) -> list[int]:
    """Return the option's horizons, which must be numbers of rows; a span of time or a date raises ValueError."""
    from heliograph.numerics.check import check_count, fail
    from heliograph.numerics.times.dates import horizons_in

    one_or_list = horizons_in(horizons)
    values = [one_or_list] if isinstance(one_or_list, int) else one_or_list
    rows_ahead = [value for value in values if isinstance(value, int)]
    if len(rows_ahead) < len(values):
        raise fail("--horizons", "numbers of rows, as 1,3,12", horizons)
    for horizon in rows_ahead:
        check_count("--horizons", horizon)
    return rows_ahead


def _describe_coverage(score: "heliograph.forecasting.Score") -> str:
    """Return a line on how often the values that came were within a forecast's intervals."""
    shares = ", ".join(f"{share.value:.1%} +- {share.error:.1%}" for share in score.coverage)
    return (
        f"{score.node}/{score.filter} {score.part} {score.name}, {score.horizon} ahead: within the "
        f"intervals of 50, 80, 95 %: {shares}"
    )


def _make_refit(reference: str, recording: "Recording", advance: "Advance") -> "Callable[[int], Network]":
    """Return a function from a number of rows to the network whose free numbers are fitted to so many first rows.

    `reference`: the network as the user named it, FILE or FILE:NAME.
    """
    from heliograph.files.fitted import NetworkAgain

    # Measurements by node, inputs; NetworkAgain builds the network anew, so that its free numbers can be replaced.
    build, (z, u, _, _) = NetworkAgain(reference), recording

    def fit_to_first(rows: int) -> "Network":
        """Return the network that `build` makes, with its free numbers fitted to the first `rows` rows of z and u.

        `advance` shows the progress, in rows of the recording.
        """
        advance("fitting to the rows before", rows, len(recording.time))
        measurements = {name: values[:rows] for name, values in z.items()}
        return heliograph.fit(build, measurements, u[:rows]).network

    return fit_to_first
