"""Lifts of maps to monomials: powers of the output as a linear function of powers of the input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import check_count, fail
from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets, check_maps
from heliograph.random_affine.composite import AbstractMapWrapper
from heliograph.random_affine.moments.monomials import (
    JointMoments,
    count_monomials,
    evaluate_monomials,
    list_exponents,
    position,
    refuse_if_too_large,
    symmetric_power,
)


class Lift(AbstractMapWrapper):
    """Lift of a map to monomials: from those of y of degree 1 to `degree` to those of z; degree 2 is the square.

    Its order-k moments are the order-(degree k) moments of the map. A lifted input has repeated products, so a row of
    moments is one of several with the same value at every lifted point; the one returned divides by the repetitions.

    Args:
        base: the map; it must not erase.
        degree: the highest degree.
    """

    base: AbstractRandomAffine
    degree: int = eqx.field(static=True)

    def __init__(self, base: AbstractRandomAffine, degree: int):
        """Hold the map `base`, which must not erase, and the highest degree of the monomials."""
        check_count("degree of the lift", degree)
        (base,) = check_maps("lift", [base])
        if base.erases:
            raise fail("lift", "a channel without erasures", "one that erases")
        self.base, self.degree = base, degree

    @property
    def outputs(self) -> int:
        """Number of monomials of z of degree 1 to `degree`: all of (z, 1) of this degree but the constant 1."""
        return count_monomials(self.base.outputs + 1, self.degree) - 1

    @property
    def inputs(self) -> int:
        """Number of monomials of y of degree 1 to `degree`: all of (y, 1) of this degree but the constant 1."""
        return count_monomials(self.base.inputs + 1, self.degree) - 1

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw H of `base`; return its next state and Sym^degree(H), the H of the lifted map.

        Sym^degree(H) is the matrix that takes the monomials of (y, 1) of this degree to those of (z, 1) = H (y, 1).
        """
        state, h = self.base.draw(state, key)
        return state, jnp.asarray(symmetric_power(h, self.degree))

    def moments(self, order: int) -> JointMoments:
        """Return the moments of this order of the lifted map, from the moments of order degree * order of the map.

        A monomial of degree degree * order may be the product of `order` lifted inputs in several ways. Each way gets
        an equal share of its coefficient.
        """
        check_forgets("moments of a map", self)
        base_moments = self.base.moments(order * self.degree).matrix
        rows = _find_product_positions(self.base.outputs + 1, self.degree, order)
        columns = _find_product_positions(self.base.inputs + 1, self.degree, order)
        refuse_if_too_large(len(rows), len(columns), f"lifted moments of order {order}")
        repetitions = np.bincount(columns)  # number of products that equal each monomial
        matrix = base_moments[rows][:, columns] / repetitions[columns]
        return JointMoments(matrix, self.outputs, self.inputs, order)

    def degree_in(self, identity: str) -> int:
        """Return the degree in a memory's state: Sym^degree(H) has `degree` times that of H of the base map."""
        return self.degree * self.base.degree_in(identity)

    def example_input(self, generator: np.random.Generator) -> np.ndarray:
        """Return a lifted point: the monomials of an input of the base map."""
        lifted: np.ndarray = evaluate_monomials(self.base.example_input(generator), self.degree)[:-1]
        return lifted


def _find_product_positions(variables: int, degree: int, order: int) -> np.ndarray:
    """Return the position of each product of `order` monomials of `degree` among the monomials of degree * order.

    Products are in the order in which `list_exponents` lists the powers of the monomials of `degree`.
    """
    factors = list_exponents(variables, degree)
    position_of_product = position(variables, degree * order)
    exponents = np.array(factors)  # (factor, variable)
    products = [powers @ exponents for powers in np.array(list_exponents(len(factors), order))]
    return np.array([position_of_product[tuple(product.tolist())] for product in products])


def square(base: AbstractRandomAffine) -> Lift:
    """Return the lift of `base` to all monomials up to degree 2 (the quadratic lift).

    Args:
        base: a map of y to z.

    Raises:
        ValueError: when asked for moments whose matrix would need more than the stated memory.
    """
    return Lift(base, 2)
