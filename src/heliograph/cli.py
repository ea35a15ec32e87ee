"""The command `heliograph`: it reads files, calls the library and writes files. Help must not wait for JAX."""

import re
import signal
import sys
from _thread import interrupt_main
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from inspect import signature
from pathlib import Path
from threading import Timer
from types import FrameType
from typing import Annotated, Any, NoReturn

from cyclopts import App, CycloptsError, Parameter

import heliograph
from heliograph.simulation.compilation_cache import keep_compilations

BAD_INPUT, INTERRUPTED, TERMINATED = 2, 130, 143  # the last two are 128 + the signal's number

SOON = 0.01  # seconds

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


def _whole(_: type, tokens: Sequence[Any]) -> int:
    """Digits: no fraction is rounded away."""
    if not re.fullmatch(r"[+-]?[0-9]+", tokens[0].value, re.ASCII):
        raise ValueError(f"expected a whole number, got {tokens[0].value!r}")
    return int(tokens[0].value)


def _path(_: type, tokens: Sequence[Any]) -> Path:
    if not tokens[0].value or "\0" in tokens[0].value:
        raise ValueError(f"expected a path, got {tokens[0].value!r}")
    return Path(tokens[0].value)


def number(text: str) -> Parameter:
    """An option that is a whole number."""
    return Parameter(help=text, converter=_whole)


def place(text: str = "") -> Parameter:
    """An option that is a file or folder."""
    return Parameter(help=text, converter=_path)


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
    measurements: Annotated[Path, place("CSV or Parquet: time, inputs and received measurements; or events.")],
    out: Annotated[Path, place("CSV or Parquet to write: estimates with their claimed covariances.")],
    window: Annotated[float | None, Parameter(help="Of events: how long one may be late; 10 unless given.")] = None,
    lag: Annotated[float | None, Parameter(help="Of events: also estimates given what came so much later.")] = None,
) -> None:
    """Run the filters of your own network over measured data.

    A file of events has the columns node, sequence, time, arrival, and what was heard: in any order, late, twice. Then
    the estimates are those that became final, and with --lag those of a lag later stand in a file beside, OUT.lagged.

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
        from heliograph.files.events import holds_events, run_events
        from heliograph.files.network_file import load_network
        from heliograph.files.recording import read_recording, write_estimates

        loaded = load_network(network)
        if not any(node.filters for node in loaded.nodes.values()):
            raise fail(f"network {network}", "at least one filter to run", "none")
        if holds_events(measurements):
            advance("filtering events")
            record, notes = run_events(measurements, loaded, out, 10.0 if window is None else window, lag)
        else:
            if window is not None or lag is not None:
                raise fail("--window and --lag", "a file of events", f"rows of time in {measurements}")
            recording, notes = read_recording(measurements, loaded), []
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
    for line in (f"{out}: {len(record.time)} rows of {', '.join(filters)}", *notes):
        print(visible(line))


@app.command
def demo(
    *,
    out: Annotated[Path, place("Folder for the estimates, figures, report and summary; made if missing.")],
    seed: Annotated[int, number("Seed of the simulated relays.")] = 0,
) -> None:
    """Filter a recorded radio-ranging drive whose ranges arrive through simulated relays, and report."""
    example("demo", out=out, seed=seed)


@app.command
def example(
    name: Annotated[str | None, Parameter(help="Which example; without it, the list of them.")] = None,
    /,
    *,
    out: Annotated[Path | None, place("Folder for the example's own, with report and summary.")] = None,
    seed: Annotated[int, number("Seed of what is simulated.")] = 0,
    trace: Annotated[Path | None, place("Log of a radio network, for an example that takes one.")] = None,
) -> None:
    """Run an example and report, or list them."""
    from heliograph.examples import examples, load_example

    if name is None:
        known = examples()
        width = max(map(len, known))
        print("\n".join(f"{each:{width}}  {what}" for each, what in known.items()))
        return
    from heliograph.numerics.check import check_seed, fail

    run_example = load_example(name)
    target, seed = _folder("example", out), check_seed("--seed", seed)
    if trace is None:
        run_example(target, seed)
    elif "trace" not in signature(run_example).parameters:
        raise fail("--trace", "an example that takes one, such as late-data", name)
    else:
        run_example(target, seed, trace)


@app.command
def reproduce(
    method: Annotated[str | None, Parameter(help="Which publication, or all; without it, the list of them.")] = None,
    /,
    *,
    out: Annotated[Path | None, place("Folder for figures, report, record and summary.")] = None,
    runs: Annotated[int | None, number("Monte Carlo runs; each publication has its own default.")] = None,
    seed: Annotated[int, number("Seed of the simulations.")] = 0,
) -> None:
    """Run a published method as printed and as improved, and judge each of its statements by this very run."""
    from heliograph.papers import METHODS

    if method is None:
        print("\n".join(METHODS))
        return
    from heliograph.numerics.check import check_count, check_seed, fail

    chosen = list(METHODS) if method == "all" else [method]
    if method not in METHODS and method != "all":
        raise fail("method", f"one of {', '.join(METHODS)} or all", repr(method))
    target = _folder("reproduce", out)
    if runs is not None:
        check_count("--runs", runs)
    check_seed("--seed", seed)
    for name in chosen:
        import_module(METHODS[name]).reproduce(target, runs, seed)


@app.command
def sweep(
    campaign: Annotated[Path, place()],
    /,
    *,
    out: Annotated[Path, place("Folder for the results; what is already there is not computed again.")],
    workers: Annotated[int | None, number("Processes here; 0: this one; by default one a CPU.")] = None,
    scheduler: Annotated[str | None, Parameter(help="Address of a Dask scheduler to work on instead.")] = None,
    setting: Annotated[int | None, number("Run only this setting, here in one process.")] = None,
    chunk: Annotated[int | None, number("And of it only this chunk.")] = None,
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
    """Run the command, return its exit code; bad input is one line on stderr, a bug keeps its traceback.

    Ctrl-C ends it with INTERRUPTED and without a word, at any moment.
    """
    stopped: list[int] = []
    try:
        with _stoppable(stopped):
            code = _command(arguments)
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception:
        if stopped:  # what was interrupted told it in its own way
            return INTERRUPTED
        raise
    return INTERRUPTED if stopped else code


def _command(arguments: Sequence[str] | None) -> int:
    with suppress(ValueError):  # a home that cannot be written to: then everything is compiled again
        keep_compilations()
    try:
        command, bound, _ = app.parse_args(arguments, exit_on_error=False, print_error=False, verbose=False)
        code: int | None = command(*bound.args, **bound.kwargs)
        return code or 0
    except CycloptsError as error:
        return _refuse(str(error))
    except ValueError as error:
        from heliograph.numerics.check import InputError

        if not isinstance(error, InputError):
            raise
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


@contextmanager
def _stoppable(stopped: list[int]) -> Iterator[None]:
    """Have the signals to stop unwind what runs, so that no temporary file stays; notes each one to interrupt.

    An interrupt that comes while a compiler calls back, or while an object is removed, is swallowed there: it is
    raised again where that is told.
    """

    def interrupt(number: int, _: FrameType | None) -> NoReturn:
        stopped.append(number)
        raise KeyboardInterrupt

    def swallowed(what: "sys.UnraisableHookArgs") -> None:
        if issubclass(what.exc_type, KeyboardInterrupt):
            again.append(Timer(SOON, interrupt_main))  # not here: it would be swallowed once more
            again[-1].start()
        else:
            told(what)

    again: list[Timer] = []
    told, terminate = sys.unraisablehook, signal.signal(signal.SIGTERM, _terminate)
    heard = signal.getsignal(signal.SIGINT)
    if heard is not signal.SIG_IGN:  # as in the background, where nobody's Ctrl-C is meant
        signal.signal(signal.SIGINT, interrupt)
    sys.unraisablehook = swallowed
    try:
        yield
    finally:
        for timer in again:
            timer.cancel()
        sys.unraisablehook = told
        signal.signal(signal.SIGTERM, terminate)
        signal.signal(signal.SIGINT, heard)


def _folder(command: str, out: Path | None) -> Path:
    from heliograph.files.table import check_output_folder
    from heliograph.numerics.check import fail

    if out is None:
        raise fail(command, "a folder for the results (--out DIR)", "none")
    check_output_folder(out)
    return out


def _refuse(message: str) -> int:
    from heliograph.files.quoting import visible

    print("heliograph:", visible(" ".join(message.split())), file=sys.stderr)
    return BAD_INPUT


def _terminate(_: int, __: FrameType | None) -> None:
    raise SystemExit(TERMINATED)  # unwinds, so that no temporary file stays
