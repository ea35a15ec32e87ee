"""The command `heliograph`: it reads files, calls the library and writes files. Help must not wait for JAX."""

import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Annotated

from cyclopts import App, CycloptsError, Parameter

import heliograph
from heliograph.simulation.compilation_cache import keep_compilations

BAD_INPUT, INTERRUPTED, TERMINATED = 2, 130, 143  # the last two are 128 + the signal's number

EXTRAS = {  # the extra that brings a package which the core does without
    "pyarrow": "tables",
    "matplotlib": "report",
    "jinja2": "report",
    "gtsam": "recordings",
    "cvxpy": "lmi",
    "clarabel": "lmi",
    "scs": "lmi",
    "xarray": "sweep",
    "zarr": "sweep",
    "h5netcdf": "sweep",
    "h5py": "sweep",
    "dask": "cluster",
    "distributed": "cluster",
    "gym_electric_motor": "motor",
}

app = App(
    name="heliograph",
    help="State estimation over relay networks.",
    version=heliograph.__version__,
    help_format="plaintext",
)


@app.command
def run(
    network: str,
    /,
    *,
    measurements: Annotated[Path, Parameter(help="CSV or Parquet: time, inputs and received measurements.")],
    out: Annotated[Path, Parameter(help="CSV or Parquet to write: estimates with their claimed covariances.")],
) -> None:
    """Run the filters of your own network over measured data.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
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
        print(f"heliograph: warning: {failure}", file=sys.stderr)
    filters = [
        f"{node}/{name} ({estimate.claim})"
        for node, estimates in record.estimates.items()
        for name, estimate in estimates.items()
    ]
    print(f"{out}: {len(record.time)} rows of {', '.join(filters)}")


@app.command
def demo(
    *,
    out: Annotated[Path, Parameter(help="Folder for the estimates, figures, report and summary; made if missing.")],
    seed: Annotated[int, Parameter(help="Seed of the simulated relays.")] = 0,
) -> None:
    """Filter a recorded radio-ranging drive whose ranges arrive through simulated relays, and report."""
    example("demo", out=out, seed=seed)


@app.command
def example(
    name: Annotated[str | None, Parameter(help="Which example; without it, the list of them.")] = None,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="Folder for the example's own, with report and summary.")] = None,
    seed: Annotated[int, Parameter(help="Seed of what is simulated.")] = 0,
) -> None:
    """Run an example and report, or list them."""
    from heliograph.examples import examples, load_example

    if name is None:
        known = examples()
        width = max(map(len, known))
        print("\n".join(f"{each:{width}}  {what}" for each, what in known.items()))
        return
    run_example = load_example(name)
    run_example(_folder("example", out), seed)


@app.command
def reproduce(
    method: Annotated[str | None, Parameter(help="Which publication, or all; without it, the list of them.")] = None,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="Folder for figures, report, record and summary.")] = None,
    runs: Annotated[int | None, Parameter(help="Monte Carlo runs; each publication has its own default.")] = None,
    seed: Annotated[int, Parameter(help="Seed of the simulations.")] = 0,
) -> None:
    """Run a published method as printed and as improved, and judge each of its statements by this very run."""
    from heliograph.papers import METHODS

    if method is None:
        print("\n".join(METHODS))
        return
    from heliograph.numerics.check import check_count, fail

    chosen = list(METHODS) if method == "all" else [method]
    if method not in METHODS and method != "all":
        raise fail("method", f"one of {', '.join(METHODS)} or all", repr(method))
    target = _folder("reproduce", out)
    if runs is not None:
        check_count("--runs", runs)
    for name in chosen:
        import_module(METHODS[name]).reproduce(target, runs, seed)


@app.command
def sweep(
    campaign: Path,
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder for the results; what is already there is not computed again.")],
    workers: Annotated[int | None, Parameter(help="Processes on this machine; one for each CPU by default.")] = None,
    scheduler: Annotated[str | None, Parameter(help="Address of a Dask scheduler to work on instead.")] = None,
    setting: Annotated[int | None, Parameter(help="Run only this setting, here in one process.")] = None,
    chunk: Annotated[int | None, Parameter(help="And of it only this chunk.")] = None,
) -> int:
    """Simulate a network in many settings, into one labelled store that survives any interruption.

    Parameters
    ----------
    campaign:
        A TOML file that names the network's function, the settings, and how many runs of each.
    """
    from heliograph.campaign.command import sweep

    return sweep(campaign, out, workers, scheduler, setting, chunk)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command, return its exit code; bad input is one line on stderr, a bug keeps its traceback."""
    before = signal.signal(signal.SIGTERM, _terminate)
    with suppress(ValueError):  # a home that cannot be written to: then everything is compiled again
        keep_compilations()
    try:
        command, bound, _ = app.parse_args(arguments, exit_on_error=False, print_error=False, verbose=False)
        code: int | None = command(*bound.args, **bound.kwargs)
        return code or 0
    except (CycloptsError, ValueError) as error:
        return _refuse(str(error))
    except OSError as error:
        return _refuse(f"{error.filename}: {error.strerror or error}" if error.filename else str(error))
    except ModuleNotFoundError as error:
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        return _refuse(
            f'{error.name}: expected to be installed, got no such package: pip install "heliograph[{extra}]"'
        )
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, before)


def _folder(command: str, out: Path | None) -> Path:
    from heliograph.files.table import check_output_folder
    from heliograph.numerics.check import fail

    if out is None:
        raise fail(command, "a folder for the results (--out DIR)", "none")
    check_output_folder(out)
    return out


def _refuse(message: str) -> int:
    print("heliograph:", " ".join(message.split()), file=sys.stderr)
    return BAD_INPUT


def _terminate(_: int, __: FrameType | None) -> None:
    raise SystemExit(TERMINATED)  # unwinds, so that no temporary file stays
