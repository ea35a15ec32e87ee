"""`heliograph reproduce`: published methods, judged."""

from importlib import import_module
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from heliograph.cli.app import folder, number, place


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
    target = folder("reproduce", out, "" if method == "all" else method)
    if runs is not None:
        check_count("--runs", runs)
    check_seed("--seed", seed)
    import jax

    for name in chosen:
        import_module(METHODS[name]).reproduce(target, runs, seed)
        # One publication's programs are no other's: kept, those of all are gigabytes.
        jax.clear_caches()  # type: ignore[no-untyped-call]
