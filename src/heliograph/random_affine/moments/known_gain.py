"""Which outputs of a map have a known gain: their noise owes nothing to the size of what is sent."""

from functools import reduce

import numpy as np

from heliograph.numerics.traced import is_traced
from heliograph.numerics.types import Bool
from heliograph.random_affine.base import AbstractRandomAffine, fold
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.law import Constant
from heliograph.random_affine.superposed import Superposed

Outputs = Bool[np.ndarray, " m"]


def has_known_gain(channel: AbstractRandomAffine) -> bool:
    """Return whether z = G y + n with a constant G."""
    return bool(np.all(find_outputs_of_known_gain(channel)))


def find_outputs_of_known_gain(channel: AbstractRandomAffine) -> Outputs:
    """Find which components of z = G y + n have a constant row of G (m,)."""
    # Each map tells which of its outputs are such, from which of its inputs are.
    through = fold(channel, {
        GainAndNoise: lambda hop, _: lambda known: _are_rows_known(hop, known),
        Series: lambda _, parts: lambda known: reduce(lambda before, part: part(before), parts, known),
        Stack: lambda _, parts: lambda known: np.concatenate([part(known) for part in parts]),
        Superposed: lambda whole, parts: lambda known: np.all(
            [part(known[list(at)]) for part, at in zip(parts, whole.places, strict=True)], axis=0
        ),
        AbstractRandomAffine: lambda affine, _: lambda known: np.zeros(affine.outputs, bool),
    })  # fmt: skip
    found: Outputs = through(np.ones(channel.inputs, bool))
    return found


def _are_rows_known(hop: GainAndNoise, known: Outputs) -> Outputs:
    """Return which outputs of a hop of constant gain take nothing but known inputs; of another hop none."""
    takes = np.ones(hop.matrix.shape, bool) if is_traced(hop.matrix) else np.asarray(hop.matrix) != 0
    rows: Outputs = isinstance(hop.law, Constant) & ~np.any(takes & ~known, axis=1)
    return rows
