"""Refusal to run in a process forked after JAX has run, which would wait for threads that it does not have."""

import os

from heliograph.numerics.check import fail

_first: list[int] = []  # the process in which something was computed first; a fork inherits it


def check_process() -> None:
    """Raise ValueError in a fork of a process that has computed something; anywhere else remember the process.

    Raises:
        ValueError: such a fork; processes that are started anew ("spawn") know nothing of it.
    """
    here = os.getpid()
    if not _first:
        _first.append(here)
    elif _first[0] != here:
        expected = 'one started anew (multiprocessing.get_context("spawn"))'
        raise fail("process", expected, "a fork of one in which JAX has run, which would hang")
