"""The command line as a function from arguments to an exit code."""

import errno
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TextIO

from cyclopts import CycloptsError

from heliograph.cli.app_and_option_types import app, completion
from heliograph.cli.backtest import backtest
from heliograph.cli.check import check
from heliograph.cli.design import design
from heliograph.cli.export import export
from heliograph.cli.fit import fit
from heliograph.cli.inspect import inspect
from heliograph.cli.new import new
from heliograph.cli.replay import replay
from heliograph.cli.run import run
from heliograph.cli.serve import serve
from heliograph.cli.stop_signals import INTERRUPTED, SIGNALLED, unwind_on_signals
from heliograph.cli.studies import demo, example, reproduce
from heliograph.cli.sweep import explore, sweep
from heliograph.numerics.process.optional_packages import EXTRAS, MissingPackagesError, how_to_install
from heliograph.simulation.runs.compilation_cache import keep_compilations

BAD_INPUT = 2
FULL = errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO  # files name themselves, what is printed does not

# In the order of the help, each with a call of it.
COMMANDS: dict[Callable[..., object], str] = {
    new: "my_network.py",
    check: "my_network.py",
    inspect: "drive.mcap --network my_network.py",
    run: "my_network.py --measurements data.csv --out estimates.csv --report report",
    fit: "my_network.py --measurements data.csv --out fitted",
    backtest: "my_network.py --measurements data.csv --horizons 1,3,12 --out backtested",
    serve: "my_network.py --broker mqtt://localhost:1883/plants --page 8000",
    replay: "data.csv --network my_network.py --speed 10 --loss 0.1 | heliograph serve my_network.py --store none",
    export: "my_network.py --filter relay_aware --out step.c",
    demo: "--out demo",
    example: "late-data --out late-data",
    reproduce: "quadratic-bias --out quadratic-bias",
    sweep: "campaign.toml --out results",
    explore: "results --out page",
    design: "design.toml --out designed",
    completion: "bash >> ~/.bashrc",
}
for single, arguments in COMMANDS.items():
    app.command(single, help_epilogue=f"Example: heliograph {single.__name__} {arguments}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code; bad input gives one line on stderr, and a bug its traceback.

    `stopped` holds the signals that came. The exit code of a command that a signal ended is SIGNALLED (128) plus the
    signal's number.
    """
    stopped: list[int] = []
    try:
        with unwind_on_signals(stopped):
            code = _run_command(arguments)
    except KeyboardInterrupt:
        return SIGNALLED + stopped[0] if stopped else INTERRUPTED
    except Exception:
        if not stopped:  # else the interrupted code has reported it
            raise
    return SIGNALLED + stopped[0] if stopped else code


def _run_command(arguments: Sequence[str] | None) -> int:
    """Parse the arguments and run their command; return the exit status. What a user can mend is one line on stderr.

    These are errors in the arguments, input that cannot be used (InputError), files, and packages that are missing. Any
    other error is a defect of the package and is raised, with its traceback.

    `app` is the command line, by Cyclopts; `bound` are the arguments of the command's function. `_print_refusal` prints
    the line and returns the status 2.

    FULL are the error numbers of a full disk and such; EXTRAS maps a package to the extra that brings it.
    """
    with suppress(ValueError):  # where the user's home cannot be written to everything is compiled again
        keep_compilations()
    try:
        command, bound, _ = app.parse_args(arguments, exit_on_error=False, print_error=False, verbose=False)
        with _print_plain_warnings():
            code: int | None = command(*bound.args, **bound.kwargs)
        sys.stdout.flush()
        return code or 0
    except CycloptsError as error:
        return _print_refusal(str(error))
    except ValueError as error:
        from heliograph.numerics.check import InputError

        if not isinstance(error, InputError):
            raise
        return _print_refusal(str(error))
    except OSError as error:
        # What has no name of a file is the standard output, if that cannot be written to.
        where = error.filename
        if not where and (error.errno in FULL or _output_is_lost()):
            where = "standard output"
        return _print_refusal(f"{where}: {error.strerror or error}" if where else str(error))
    except MissingPackagesError as error:
        return _print_refusal(str(error))
    except ModuleNotFoundError as error:
        # A missing package of an extra: say how to install it.
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        return _print_refusal(f"{error.name}: expected to be installed, got no such package: {how_to_install(extra)}")


@contextmanager
def _print_plain_warnings() -> Iterator[None]:
    """Print warnings to users as lines of the command, without the place in the source that gave them."""
    with warnings.catch_warnings():
        of_python = warnings.showwarning

        def show(
            message: Warning | str, category: type[Warning], filename: str, lineno: int,
            file: TextIO | None = None, line: str | None = None,
        ) -> None:  # fmt: skip
            """Print a warning to users as a line; leave all others to `of_python`, Python's own function for this."""
            if issubclass(category, UserWarning):
                from heliograph.disk.quoted_text import visible

                print(f"heliograph: warning: {visible(str(message))}", file=sys.stderr if file is None else file)
            else:
                of_python(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        yield


def _output_is_lost() -> bool:
    """Return whether standard output can no longer be written, as after `| head`.

    An OSError does not say where it arose, so it is tried.
    """
    try:
        sys.stdout.flush()
    except OSError:
        return True
    return False


def _print_refusal(message: str) -> int:
    """Print an error as one line, and return the exit status of bad input."""

    from heliograph.disk.quoted_text import visible

    print("heliograph:", visible(" ".join(message.split())), file=sys.stderr)
    return BAD_INPUT
