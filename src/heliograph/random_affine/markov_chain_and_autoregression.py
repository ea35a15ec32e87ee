"""Memories of links: a Markov chain of modes, or a Gaussian fading that drifts; neither depends on what is sent.

A memory has a state that moves from step to step. Given its state a link forgets: gain and noise are drawn anew.
"""

from collections.abc import Iterable
from copy import copy
from math import comb, factorial
from typing import NamedTuple
from uuid import uuid4

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial.hermite_e import hermegauss, hermevander

from heliograph.numerics.caching import cache_arrays
from heliograph.numerics.check import PROBABILITY_TOLERANCE, array, check_count, fail, probabilities, radii, scalar
from heliograph.numerics.domains import PROBABILITY, SIMPLEX, report_domain
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.numpy_or_jax import equal_to_rounding, is_traced, library, within
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.laws.law import draw_index

Rows = Float[jax.Array | np.ndarray, "modes modes"]
Law = Float[jax.Array | np.ndarray, " modes"]


class MemoryStates(NamedTuple):
    """Finitely many states of a memory: their law at the first use, and row by row that of the next given the present.

    The rows sum to 1. Their entries are probabilities for a chain; for a drifting fading they reproduce all
    expectations of polynomials up to a degree, and may be negative.
    """

    states: jax.Array | np.ndarray
    initial: Law
    transition: Rows
    radius: Rows | float = 0.0


@readable
class AbstractMemory(Module):
    """Memory of a link: a state that moves from step to step, on which the law of gain and noise depends.

    Links share a memory by its `name`, which also seeds its draws (shared fading, `hg.shared`). One without a name is
    of one link: where an object stands at several nodes or hops, each has its own. Within one map the maps that refer
    to one object are in one state.
    """

    name: eqx.AbstractVar[str | None]
    identity: eqx.AbstractVar[str]

    @property
    def drifts(self) -> bool:
        """True if the state is a number that drifts, False if it is one of finitely many modes."""
        return False

    @property
    def is_uncertain(self) -> bool:
        """True if its law is known only within a radius."""
        return False

    def begin(self, key: jax.Array) -> jax.Array:
        """Draw the state at the first use of the link."""
        raise unwritten(self, "begin")

    def move(self, state: jax.Array, key: jax.Array) -> jax.Array:
        """Draw the next state, given the present one."""
        raise unwritten(self, "move")

    def nodes(self, degree: int) -> MemoryStates:
        """Return the memory as finitely many states, exact for a mean that is a polynomial of `degree` in the state."""
        raise unwritten(self, "nodes")

    @property
    def announced(self) -> int:
        """Number of values that a message reports of the state, where it reports the state; by default one."""
        return 1

    def announce(self, state: int | float | jax.Array | np.ndarray) -> jax.Array | np.ndarray:
        """Return the values (announced,) that a message reports of the state; by default the state itself."""
        numbers: jax.Array | np.ndarray = library(state).stack([state])
        return numbers

    def state_from_number(self, number: jax.Array) -> jax.Array:
        """Return the state of which a message reports this number."""
        raise unwritten(self, "state_from_number")

    def next_state_quadrature(self, state: jax.Array | None, degree: int) -> tuple[jax.Array | np.ndarray, Law]:
        """Return points and weights of a quadrature of the next state s+ given the present `state`.

        E[f(s+)] = sum_i weight_i f(point_i), exact for polynomials f of up to twice the `degree`. If `state` is None,
        the quadrature is for the law of the first state.
        """
        raise unwritten(self, "next_state_quadrature")

    def labelled(self, label: str) -> "AbstractMemory":
        """Return a copy without a name, with `label` as identity: only copies of this label share its state."""
        labelled_copy = copy(self)  # a construction would check numbers that may be stacked over time
        object.__setattr__(labelled_copy, "name", None)  # fields are frozen
        object.__setattr__(labelled_copy, "identity", label)
        return labelled_copy

    def named(self, name: str) -> "AbstractMemory":
        """Return a copy with this name; all memories of one name are the same memory."""
        named_copy = self.labelled(identify_memory(name))
        object.__setattr__(named_copy, "name", name)
        return named_copy


class MarkovChain(AbstractMemory):
    """Markov chain of modes 0, 1, ...: transition[i, j] = P(next mode j | present mode i).

    Args:
        transition: probabilities (modes, modes), each row a law. Where it varies in time (channels in `over_time`),
            that of
            step k leads from step k to step k + 1.
        initial: law (modes,) of the mode at the first use; the stationary law unless given.
        name: name by which copies and nodes of a network share the chain; None for a chain of its own.
        radius: how far each probability may be off, differently at each step; one number or (modes, modes), 0 unless
            given.

    Raises:
        ValueError: rows that are no probabilities; no initial law, and more than one stationary law.
    """

    transition: Rows
    initial: Law
    radius: np.ndarray
    name: str | None = eqx.field(static=True)
    identity: str = eqx.field(static=True)

    def __init__(
        self,
        transition: "Float[ArrayLike, 'modes modes']",
        initial: "Float[ArrayLike, ' modes'] | None" = None,
        name: str | None = None,
        radius: "Float[ArrayLike, '*modes']" = 0.0,
    ):
        """Hold transition matrix, initial law (None: stationary), name, and the probabilities' largest errors."""
        report_domain("transition matrix", transition, SIMPLEX, PROBABILITY)
        self.transition = rows = array("transition matrix", transition, ("modes", "modes"))
        if rows.shape[0] != rows.shape[1] or not rows.size:
            raise fail("transition matrix", "a square matrix", f"shape {rows.shape}")
        for i, row in enumerate(rows):
            probabilities(f"transition from mode {i}", row)
        self.radius = radii("radius of the transition", radius, rows)
        self.initial = (
            find_stationary_law(rows) if initial is None else probabilities("initial law", initial, len(rows))
        )
        self.name, self.identity = name, identify_memory(name)

    @property
    def is_uncertain(self) -> bool:
        """True if some transition probability is known only within a radius."""
        return bool(np.any(self.radius > 0))

    def covers(self, actual: "MarkovChain") -> bool:
        """Return whether `actual` is the same memory, and all transitions that it may have are possible for this chain.

        The radius is how far each probability of a transition may be off.
        """
        if actual.identity != self.identity or not equal_to_rounding(self.initial, actual.initial):
            return False
        return within(actual.transition, actual.radius, self.transition, self.radius)

    @property
    def modes(self) -> int:
        """Number of modes."""
        return int(self.transition.shape[-1])

    def begin(self, key: jax.Array) -> jax.Array:
        """Draw the mode at the first use."""
        return draw_index(self.initial, key)

    def move(self, state: jax.Array, key: jax.Array) -> jax.Array:
        """Draw the next mode j with P(j) = transition[state, j]."""
        return draw_index(jnp.asarray(self.transition)[state], key)

    def nodes(self, degree: int) -> MemoryStates:
        """Return the modes, with the chain's initial law and transition: exact whatever the degree."""
        return MemoryStates(np.arange(self.modes), self.initial, self.transition, self.radius)

    def state_from_number(self, number: jax.Array) -> jax.Array:
        """Return the number without its fraction, as a mode from 0 to `modes` - 1."""
        return jnp.clip(jnp.asarray(number).astype(int), 0, self.modes - 1)

    def next_state_quadrature(self, state: jax.Array | None, degree: int) -> tuple[jax.Array | np.ndarray, Law]:
        """Return the modes (modes,) and their probabilities: exact, so that `degree` does not matter."""
        law = jnp.asarray(self.initial) if state is None else jnp.asarray(self.transition)[state]
        return jnp.arange(self.modes), law


class CertainChain(MarkovChain):
    """A chain whose transitions are certain, also where all numbers are traced.

    Raises:
        ValueError: a chain whose transitions may be off.
    """

    def __init__(self, chain: MarkovChain):
        """Copy a chain; raise ValueError unless its transitions are certain (radius 0)."""
        if chain.is_uncertain:
            raise fail("transitions of a chain", "known ones, beside what a message tells", "uncertain ones")
        self.transition, self.initial, self.radius = chain.transition, chain.initial, chain.radius
        self.name, self.identity = chain.name, chain.identity

    @property
    def is_uncertain(self) -> bool:
        """Always False: the constructor refused uncertain transitions, and traced ones cannot be asked."""
        return False


class Autoregression(AbstractMemory):
    """Gaussian memory with mean 0 and variance 1 that drifts, c+ = rho c + sqrt(1 - rho^2) e, always stationary.

    Args:
        correlation: rho between one step and the next, from -1 to 1.
        name: name by which copies and nodes of a network share the memory; None for one of its own.

    Raises:
        ValueError: a correlation outside [-1, 1].
    """

    correlation: Float[jax.Array | np.ndarray, ""]
    name: str | None = eqx.field(static=True)
    identity: str = eqx.field(static=True)

    def __init__(self, correlation: "Float[ArrayLike, '']", name: str | None = None):
        """Hold the correlation rho of successive values and the name under which links share the memory."""
        self.correlation = scalar("correlation from step to step", correlation, -1.0, 1.0)
        self.name, self.identity = name, identify_memory(name)

    @property
    def drifts(self) -> bool:
        """Always True: the state is a real number."""
        return True

    def begin(self, key: jax.Array) -> jax.Array:
        """Draw the first state c from N(0, 1), the stationary law."""
        return jax.random.normal(key, dtype=float)

    def move(self, state: jax.Array, key: jax.Array) -> jax.Array:
        """Draw the next state c+ = rho c + sqrt(1 - rho^2) e from the present one c (`state`), with e of N(0, 1)."""
        rho = jnp.asarray(self.correlation)
        return rho * state + jnp.sqrt(1 - rho**2) * jax.random.normal(key, dtype=float)

    def nodes(self, degree: int) -> MemoryStates:
        """Return N = degree + 1 Gauss-Hermite nodes x as states, with their weights w and transitions.

        The state c+ = rho c + sqrt(1 - rho^2) e is standard normal. L_j is the Lagrange polynomial that is 1 at x_j and
        0 at the other nodes, and stands for the indicator of a mode. The transition is E[L_j(c+) | c = x_i] =
        sum_{m < N} rho^m h_m(x_i) h_m(x_j) w_j, with the normalised Hermite polynomials h_m. Expectations of
        polynomials up to degree 2 N - 1 are exact. For degree 1 this is a chain with the states -1 and 1, which
        switches with probability (1 - rho) / 2.
        """
        x, w, hermite = _hermite_quadrature(check_count("degree", degree, least=0) + 1)
        powers_of_rho = library(self.correlation).asarray(self.correlation) ** np.arange(len(x))
        transition = (hermite * powers_of_rho) @ hermite.T * w
        return MemoryStates(x, w, transition)

    def state_from_number(self, number: jax.Array) -> jax.Array:
        """Return the number itself: the state is a real number."""
        return number

    def next_state_quadrature(self, state: jax.Array | None, degree: int) -> tuple[jax.Array | np.ndarray, Law]:
        """Return next states rho c + sqrt(1 - rho^2) x at Gauss-Hermite nodes x, and their weights; c is the state.

        If `state` is None, at the first use, the next states are x itself, since the state is standard normal.
        """
        x, w, _ = _hermite_quadrature(degree + 1)
        rho = jnp.asarray(self.correlation)
        if state is None:
            return jnp.asarray(x), w
        return rho * state + jnp.sqrt(1 - rho**2) * x, w

    def chain(self, modes: int) -> MemoryStates:
        """Return a chain with the same mean, variance and correlation, whose probabilities are not negative.

        Its n + 1 = `modes` states are the numbers of heads of n fair coins, centred and scaled to variance 1. At each
        step every coin stays with probability (1 + rho) / 2, and else turns, so that E[c+ | c] = rho c.

        Source: Rouwenhorst, Asset pricing implications of equilibrium business cycle models (1995).
        """
        n = check_count("modes of a fading", modes, least=2) - 1
        xp = library(self.correlation)
        stays = (1 + xp.asarray(self.correlation)) / 2
        rows = []
        for heads in range(n + 1):
            stay_heads = _compute_binomial_probabilities(heads, stays)
            become_heads = _compute_binomial_probabilities(n - heads, 1 - stays)
            rows.append(xp.convolve(stay_heads, become_heads))  # the law of the sum of both numbers
        states = np.sqrt(n) * np.linspace(-1, 1, n + 1)
        return MemoryStates(states, _compute_binomial_probabilities(n, np.asarray(0.5)), xp.stack(rows))


def find_stationary_law(transition: Rows) -> Law:
    """Return the stationary law p of a chain with the transition matrix Pi: p = p Pi and sum p = 1.

    Raises:
        ValueError: several stationary laws, as the rank of Pi - I shows (not checked if Pi is traced).
    """
    m = len(transition)
    xp = library(transition)
    if not is_traced(transition) and np.linalg.matrix_rank(transition - np.eye(m), tol=PROBABILITY_TOLERANCE) < m - 1:
        raise fail("initial law", "one, since the chain has several stationary laws", "none")
    # One equation of p (Pi - I) = 0 follows from the others. It is replaced by sum p = 1.
    balance = xp.concatenate([(transition.T - np.eye(m))[:-1], np.ones((1, m))])
    law = xp.linalg.solve(balance, np.eye(m)[-1])
    law = xp.maximum(law, 0.0)
    normalised: Law = law / law.sum()
    return normalised


def identify_memory(name: str | None) -> str:
    """Return a text that identifies a memory: by its name, or else a random text, which copies of it keep."""
    if name is not None and (not isinstance(name, str) or not name):
        raise fail("name of a memory", "a text", repr(name))
    return uuid4().hex if name is None else f"named {name}"


def _compute_binomial_probabilities(n: int, p: jax.Array | np.ndarray) -> jax.Array | np.ndarray:
    """Return the probabilities (n + 1,) of 0, ..., n successes in n trials, each with the probability p."""
    k = np.arange(n + 1)
    coefficients = np.array([comb(n, i) for i in k], dtype=float)
    probabilities: jax.Array | np.ndarray = coefficients * p**k * (1 - p) ** (n - k)
    return probabilities


@cache_arrays
def _hermite_quadrature(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Gauss-Hermite nodes x, weights w, and (node, m) normalised Hermite polynomials h_m(x), m < count.

    They belong to the standard normal law: the weights sum to 1, and E[h_m h_n] is 1 for m = n, and 0 else.
    """
    x, w = hermegauss(count)
    scale = np.sqrt([float(factorial(m)) for m in range(count)])
    return x, w / np.sqrt(2 * np.pi), hermevander(x, count - 1) / scale


def unique_memories(all_memories: Iterable[AbstractMemory]) -> dict[str, AbstractMemory]:
    """Return the memories in order of appearance, each once, by their identities (texts by which maps share them).

    Raises:
        ValueError: memories of one identity (of one name) that differ.
    """
    by_identity: dict[str, AbstractMemory] = {}
    for memory in all_memories:
        first_of_identity = by_identity.setdefault(memory.identity, memory)
        if not (
            first_of_identity is memory
            or is_traced(first_of_identity, memory)
            or eqx.tree_equal(first_of_identity, memory)
        ):
            raise fail(f"memory {first_of_identity.name!r}", "one transition and one initial law", "several")
    return by_identity
