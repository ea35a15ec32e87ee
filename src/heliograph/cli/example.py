"""`heliograph example` and `heliograph demo`, which is the first of them."""

from inspect import signature
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from heliograph.cli.app import folder, number, place


def demo(
    *,
    out: Annotated[Path, place("Folder for the estimates, figures, report and summary; made if missing.")],
    seed: Annotated[int, number("Seed of the simulated relays.")] = 0,
    recording: Annotated[str, Parameter(help="Which drive: plaza1 or plaza2.")] = "plaza2",
) -> None:
    """Filter a recorded radio-ranging drive whose ranges arrive through simulated relays, and report."""
    from heliograph.examples.demo import example as demonstrate
    from heliograph.numerics.check import check_seed

    demonstrate(folder("demo", out, "demo"), check_seed("--seed", seed), recording)


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
    target, seed = folder("example", out, name), check_seed("--seed", seed)
    if trace is None:
        run_example(target, seed)
    elif "trace" not in signature(run_example).parameters:
        raise fail("--trace", "an example that takes one, such as late-data", name)
    else:
        run_example(target, seed, trace)
