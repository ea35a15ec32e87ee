"""How many Monte Carlo runs a reproduction makes."""

from heliograph.numerics.check import fail


def check_runs(runs: int | None, default: int, fewest: int) -> int:
    """Return `runs`, or the default; a standard error needs the fewest."""
    count = default if runs is None else runs
    if int(count) != count or count < fewest:
        raise fail("runs", f"a whole number of at least {fewest}", count)
    return int(count)
