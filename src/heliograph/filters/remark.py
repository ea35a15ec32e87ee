"""Remark of a filter on what happened to its state: words, and how often, such as that a gate gave in."""

from dataclasses import dataclass

from heliograph.numerics.module import readable


@readable
@dataclass(frozen=True)
class Remark:
    """What happened to a filter's state that its user should know, such as that a gate gave in.

    Args:
        times: how often it has happened (default 0).
        words: what, and when it last did; "" where it never has.
    """

    times: int = 0
    words: str = ""
