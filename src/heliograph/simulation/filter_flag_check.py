"""Flags of channels beside a measurement, which tell their modes: those that a filter's model has, and no others."""

from collections.abc import Sequence

import jax

from heliograph.filters.base import AbstractFilter
from heliograph.filters.modes.mode_observed import ModeObservedFilter
from heliograph.filters.modes.side_information import SideInformationFilter
from heliograph.model.over_time import first
from heliograph.numerics.check import fail
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.modes import ModeOutput, OneStepLate

NOW, LATE = "hg.model.with_flag(link)", "hg.model.with_flag(link, late=True)"


def check_filter_flags(name: str, filter: AbstractFilter, channels: Sequence[AbstractRandomAffine]) -> None:
    """Raise ValueError unless the flags that these channels deliver are those of the filter's model.

    A flag is a number that is received after the measurement and tells the mode of a link (such as good or bad), in
    this step or the step before (late). A filter that took a late flag for one of this step would claim a wrong
    covariance.

    Args:
        name: name of the filter, for the error.
        filter: with all filters inside it.
        channels: channels whose outputs the filter receives, one after another.

    Raises:
        ValueError: a flag of another step; no flag where a filter uses the mode.
    """
    # The channel that makes each received number: a channel may be several in parallel.
    channel_of_number = [part for channel in channels for part in channel.in_parallel for _ in range(part.outputs)]
    for reader in _find_flag_filters(filter):
        if isinstance(reader, ModeObservedFilter):
            # All received numbers after the channel's outputs are flags.
            measured, expected = first(reader.channel).outputs, LATE if reader.late else NOW
            flags = channel_of_number[measured : reader.received]
            wrong = [flag for flag in flags if not _reveals_mode(flag, reader.late)]
        else:
            # The last number is a flag, of this step.
            expected = "hg.model.with_flag(link, flags)"
            flags = channel_of_number[reader.received - 1 : reader.received]
            wrong = [flag for flag in flags if isinstance(flag, OneStepLate)]
        if wrong:
            if isinstance(wrong[0], OneStepLate):
                got = "one of the step before"
            elif isinstance(wrong[0], ModeOutput):
                got = "one of this step"
            else:
                got = f"{type(wrong[0]).__name__}, no mode"
            raise fail(f"{name}, flags", f"those of {expected}", got)


def _find_flag_filters(filter: AbstractFilter) -> list[SideInformationFilter | ModeObservedFilter]:
    """Return the filters that use flags, also those inside other filters.

    A flag is a number after the measurement that tells the mode of a link. `ModeObservedFilter` always uses flags,
    `SideInformationFilter` only where it is `flagged`: else it uses other side information, without flags.
    """
    kinds = SideInformationFilter, ModeObservedFilter
    # The filter as a tree, whose leaves are filters of these kinds, or arrays.
    leaves = jax.tree.leaves(filter, is_leaf=lambda leaf: isinstance(leaf, kinds))
    found: list[SideInformationFilter | ModeObservedFilter] = []
    for leaf in leaves:
        if isinstance(leaf, ModeObservedFilter) or (isinstance(leaf, SideInformationFilter) and leaf.flagged):
            found.append(leaf)
    return found


def _reveals_mode(affine: AbstractRandomAffine, late: bool) -> bool:
    """Return whether a map delivers the mode of a memory: that of the previous step if `late`, else of this step."""
    if late:
        return isinstance(affine, OneStepLate) and isinstance(affine.base, ModeOutput)
    return isinstance(affine, ModeOutput)
