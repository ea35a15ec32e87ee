"""What maps made of maps have in common: laws of one map each that are independent of each other."""

from collections.abc import Sequence
from itertools import product
from math import prod

import equinox as eqx
import jax
import numpy as np

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.check import fail
from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine, inner_maps, replace_inner_maps
from heliograph.random_affine.moments.signal_path import ChannelPosition, Visit, refuse_gain_on_angles

ARROW, DIRECT = " → ", "direct"  # texts between maps in series, and for a map that only selects components


class AbstractComposite(AbstractRandomAffine):
    """Random affine map made of independent maps (`parts`); its moments are linear in the law of each of them.

    So its extreme laws, at which bounds are reached, are the combinations of extreme laws of the parts.
    """

    @property
    def parts(self) -> Sequence[AbstractRandomAffine]:
        """The maps that this one is made of: those among its fields."""
        return inner_maps(self)

    def rebuilt(self, *parts: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return the same kind of map made of these maps in place of its own `parts`."""
        return replace_inner_maps(self, parts)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """Return the same map made of each combination of one extreme law of each part."""
        combinations = product(*(affine.extremes() for affine in self.parts))
        return tuple(self.rebuilt(*parts) for parts in combinations)

    def corner_count(self) -> int:
        """Return the number of combinations of one extreme law of each part."""
        return prod(affine.corner_count() for affine in self.parts)

    def mean_gain(self) -> AbstractRandomAffine:
        """Return the same map made of its parts with their mean gains."""
        return self.rebuilt(*(affine.mean_gain() for affine in self.parts))


class AbstractMapWrapper(AbstractComposite):
    """Random affine map made of one other, with its shapes and state unless it says otherwise."""

    @property
    def outputs(self) -> int:
        """Length of z: that of the part."""
        return self.parts[0].outputs

    @property
    def inputs(self) -> int:
        """Length of y: that of the part."""
        return self.parts[0].inputs

    def _init(self, key: jax.Array) -> PyTree[jax.Array]:
        """Draw the initial state of the one map inside, which is the state of this map."""
        return self.parts[0].init(key)


class AbstractOneOfSeveralMaps(AbstractRandomAffine):
    """Random affine map that is at each step one of several maps of one shape."""

    maps: eqx.AbstractVar[tuple[AbstractRandomAffine, ...]]

    @property
    def outputs(self) -> int:
        """Length of z: that of each of the maps."""
        return self.maps[0].outputs

    @property
    def inputs(self) -> int:
        """Length of y: that of each of the maps."""
        return self.maps[0].inputs

    def carry_angles(self, sent: Angles) -> Angles:
        """Return which outputs are angles if the inputs `sent` are; all maps must agree, since any may be in force."""
        results = {affine.carry_angles(sent) for affine in self.maps}
        if len(results) > 1:
            raise refuse_gain_on_angles(type(self).__name__)
        return results.pop()

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the map with `visit` applied to each hop of each of its maps, and the position behind the longest.

        A hop is a transmitter with its link, and the position counts the hops before it. All maps begin at `position`:
        hops at equal places in several maps are the same transmitter.
        """
        visited_maps = [affine.visit_hops(visit, position) for affine in self.maps]
        visited: AbstractRandomAffine = replace_inner_maps(self, [affine for affine, _ in visited_maps])
        positions = [after for _, after in visited_maps]
        return visited, max(positions, key=lambda position: position.hops)

    def check_shapes(self, name: str) -> None:
        """Raise ValueError if the maps differ in shape; `name` says in the message what has these maps."""
        shapes = [(m.outputs, m.inputs) for m in self.maps]
        if len(set(shapes)) != 1:
            raise fail(name, "maps of one shape", shapes)


def describe_maps_side_by_side(maps: Sequence[AbstractRandomAffine]) -> str:
    """Return maps side by side in words, with bars between them; equal ones by their number."""
    parts = [affine.in_words() or DIRECT for affine in maps]
    return f"{len(parts)} × ({parts[0]})" if len(set(parts)) == 1 else f"({' | '.join(parts)})"


def write_percentage(share: object) -> str:
    """Return a share from 0 to 1 as a text in percent with three digits, such as 2.5%."""
    return f"{100 * float(np.asarray(share)):.3g}%"
