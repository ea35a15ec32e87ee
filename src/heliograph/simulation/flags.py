"""Check that the flags that reach a filter are of the kind that it uses: of this step, or of the step before."""

from collections.abc import Iterator, Sequence

import jax

from heliograph.filters.base import AbstractFilter
from heliograph.filters.modes.mode_observed import ModeObservedFilter
from heliograph.filters.modes.side_information import SideInformationFilter
from heliograph.model.over_time import first
from heliograph.numerics.check import fail
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Stack
from heliograph.random_affine.modes import ModeOutput, OneStepLate

NOW, LATE = "hg.model.with_flag(link)", "hg.model.with_flag(link, late=True)"


def check_flags(name: str, item: AbstractFilter, channels: Sequence[AbstractRandomAffine]) -> None:
    """Refuse channels, one after another, whose flags are not those of the filter's model: its claim would be wrong.

    Raises:
        ValueError: a flag of another step; no flag where a filter uses the mode.
    """
    rows = [part for channel in channels for part in _rows(channel)]
    # Flags stand after the measurement; each comes from one row of the channels.
    for reader in _readers(item):
        if isinstance(reader, ModeObservedFilter):
            sent, expected = first(reader.channel).outputs, LATE if reader.late else NOW
            wrong = [part for part in rows[sent : reader.received] if not _reveals(part, reader.late)]
        else:
            expected = "hg.model.with_flag(link, flags)"
            wrong = [part for part in rows[reader.received - 1 : reader.received] if isinstance(part, OneStepLate)]
        if wrong:
            late = isinstance(wrong[0], OneStepLate)
            plain = "one of this step" if isinstance(wrong[0], ModeOutput) else f"{type(wrong[0]).__name__}, no mode"
            raise fail(f"{name}, flags", f"those of {expected}", "one of the step before" if late else plain)


def _readers(item: AbstractFilter) -> list[SideInformationFilter | ModeObservedFilter]:
    """Filters that use flags, after the measurement in the received vector; also inside of others."""
    kinds = SideInformationFilter, ModeObservedFilter
    leaves = jax.tree.leaves(item, is_leaf=lambda part: isinstance(part, kinds))
    return [
        part
        for part in leaves
        if isinstance(part, ModeObservedFilter) or (isinstance(part, SideInformationFilter) and part.flagged)
    ]


def _rows(channel: AbstractRandomAffine) -> Iterator[AbstractRandomAffine]:
    """Yield for each output the map that it comes from."""
    if isinstance(channel, Stack):
        for part in channel.maps:
            yield from _rows(part)
    else:
        yield from [channel] * channel.outputs


def _reveals(part: AbstractRandomAffine, late: bool) -> bool:
    if late:
        return isinstance(part, OneStepLate) and isinstance(part.base, ModeOutput)
    return isinstance(part, ModeOutput)
