"""Bound on the mean covariance of a filter over the numbers that its links may report, before any are drawn.

Such numbers ("told numbers", channel side information) are reported with each message, and say what the link did to it:
its gain, a reading of the gain, or its noise variance.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import from_covariance
from heliograph.filters.base import AbstractFilter
from heliograph.filters.linear.linear import LinearFilter
from heliograph.filters.linear.linear_filter_state import LinearBelief
from heliograph.filters.wrappers.told_link_law import ToldFilter
from heliograph.model.over_time import first
from heliograph.numerics.check import check_count, fail, show_value
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.times.data_row_checks import check_rows
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.channel_state_information import list_told_maps
from heliograph.random_affine.laws.gain_given_reading import gain_quadrature, reading_quadrature
from heliograph.random_affine.laws.law import AbstractLaw
from heliograph.random_affine.markov_chain_and_autoregression import AbstractMemory, MarkovChain
from heliograph.random_affine.noises.noise import FiniteSupport
from heliograph.random_affine.reported_numbers import FreshNumbers, FreshReading

MOST = 20_000  # combinations of numbers that are summed over


# What is carried from step to step: a filter's state, covariances by mode (modes, n, n), and the modes' law (modes,).
Carry = tuple[LinearBelief, jax.Array, jax.Array]


class ToldNumbersByMode(NamedTuple):
    """Numbers that a message may report at a step, by mode of a Markov chain; one mode if they are drawn anew.

    In each mode there are quadrature nodes: `numbers` (modes, nodes, told) are their values, and `weights` (modes,
    nodes), which sum to 1 in each mode, their probabilities. Shapes: initial (modes,), transition (modes, modes).
    """

    numbers: Float[np.ndarray, "modes nodes told"]
    weights: Float[np.ndarray, "modes nodes"]
    initial: Float[np.ndarray, " modes"]
    transition: Float[np.ndarray, "modes modes"]


def mean_error_bound(
    filter: AbstractFilter, steps: int, inputs: "Float[ArrayLike, 'steps inputs'] | None" = None
) -> Float[np.ndarray, "steps n n"]:
    """Bound the mean of a filter's covariance over all numbers that messages may report, at each step, before any data.

    After a message that reports the numbers a, a covariance P becomes f(P, a), which is concave and increasing in P. If
    the numbers are drawn anew each step, V+ = E f(V, a) is at least E P+, and at most the covariance that a filter
    claims which knows only their law. For numbers of a Markov chain, V+_j = f(sum_i b_ij V_i, a_j) in mode j, with
    b_ij = P(i before | j now). Means over gains with a density are sums over Gauss's nodes. A message is assumed to
    arrive at each step.

    Args:
        filter: a `linear_filter` behind a link that reports gains, readings of gains, or numbers that have finitely
            many values or the law of one gain.
        steps: number of steps.
        inputs: rows (steps, inputs); by default there are none, as for a filter without inputs.

    Claim: "upper".

    Raises:
        ValueError: another filter, numbers without a law or with another one, inputs of another size.
    Source: Jensen's inequality.
    """
    check_count("steps", steps)
    # A ToldFilter corrects with each message as if the link had the gain, or noise, that the message reports.
    if not (isinstance(filter, ToldFilter) and isinstance(filter.base, LinearFilter)):
        got = type(filter).__name__ if isinstance(filter, AbstractFilter) else show_value(filter)
        raise fail("filter", "a linear_filter behind a link without memory that tells numbers", got)
    rows_of_inputs = np.zeros((steps, 0)) if inputs is None and not filter.inputs else inputs
    u = check_rows("inputs", rows_of_inputs, steps, len(filter.inputs), missing=False)
    return np.asarray(_bound_mean_covariance(filter, _list_told_numbers(filter), np.asarray(u)))


@compile_in_float64
def _bound_mean_covariance(filter: ToldFilter, told: ToldNumbersByMode, u: Array) -> jax.Array:
    """Return the bound on the mean covariance at each step (steps, n, n): compiled body of `mean_error_bound`.

    In mode j of the chain, V+_j = sum_a P(a | j) f(sum_i b_ij V_i, a), where f(P, a) is the covariance after a step
    from the covariance P with a message that reports the numbers a, and b_ij = P(i before | j now). The output is sum_j
    P(j) V+_j.

    Args:
        filter: a linear filter behind a link that reports numbers with each message.
        told: the numbers that may be reported in each mode, and the chain.
        u: inputs (steps, inputs).
    """
    start = filter.init()
    modes = len(told.initial)

    def bound_step(carry: Carry, row: tuple[jax.Array, jax.Array]) -> tuple[Carry, jax.Array]:
        """Bound the mean covariance V_j in each mode j after one row; the output is its mean over the modes.

        `carry`: a filter's state, the bounds V_j before the row, and the modes' probabilities. `row`: number and input.
        """
        state, before, law = carry
        k, u_k = row

        def step_in_mode(
            covariance: jax.Array, numbers: jax.Array, weights: jax.Array
        ) -> tuple[LinearBelief, jax.Array]:
            """Return the prediction in one mode, and the mean covariance after the message, sum_a p(a) f(P, a).

            `covariance` is that before the step. `numbers` (count, told) are the messages a that the mode may bring,
            with the probabilities p(a) in `weights`. u_k is the input of step k.
            """
            gaussian = from_covariance(state.gaussian.mean, covariance)
            prior = filter.predict(state._replace(gaussian=gaussian), u_k, k)
            covariances_after = jax.vmap(lambda a: _correct_covariance(filter, prior, a, k))(numbers)
            return prior, jnp.tensordot(weights, covariances_after, 1)

        priors, after = jax.vmap(step_in_mode)(before, jnp.asarray(told.numbers), jnp.asarray(told.weights))
        # V of each mode of the next step: the mean over the modes that may come before it.
        next_law = law @ told.transition
        back = law[:, None] * told.transition / jnp.where(next_law > 0, next_law, 1.0)  # P(i now | j next)
        mixed = jnp.einsum("ij,iab->jab", back, after)
        # All modes share the moments of the plant's state, so that one of their predictions goes on.
        return (jax.tree.map(lambda leaf: leaf[0], priors), mixed, next_law), jnp.tensordot(law, after, 1)

    covariances = jnp.broadcast_to(start.gaussian.covariance, (modes, *start.gaussian.covariance.shape))
    carry = jax.tree.map(jnp.asarray, start), covariances, jnp.asarray(told.initial)
    covariances_over_time: jax.Array = jax.lax.scan(bound_step, carry, (jnp.arange(len(u)), jnp.asarray(u)))[1]
    return covariances_over_time


def _correct_covariance(filter: ToldFilter, prior: LinearBelief, numbers: jax.Array, k: jax.Array) -> jax.Array:
    """Return f(P, a), the covariance (n, n) after a message that reports the numbers a; P is that of `prior`.

    The covariance of a linear filter does not depend on the measured values, so zeros stand for them.
    """
    indices_in_message = np.array(filter.numbers)  # rows of z that hold reported numbers
    z = jnp.zeros(filter.received).at[indices_in_message].set(numbers)
    after, _ = filter.correct(prior, z, k)
    covariance: jax.Array = after.gaussian.covariance
    return covariance


def _list_told_numbers(filter: ToldFilter) -> ToldNumbersByMode:
    """Return the numbers that a message may report, with their probabilities, by mode of the chain that decides them.

    With them the mean of the filter's covariance over all reports is bounded. A Markov chain reports its mode, a single
    number in each mode. Numbers that are drawn anew at each step have one mode, with all combinations of the numbers of
    all links that report some; a continuous law is replaced by quadrature nodes with weights.

    Args:
        filter: corrects with each message by the law of the link (a gain, a noise variance) that the message reports.

    Raises:
        ValueError: a chain beside other reports or with unknown or varying probabilities, or more than MOST nodes.
    """
    # The memory of a link draws the reported numbers: a Markov chain, or a law from which they are drawn anew.
    memories = [affine.memory for affine in list_told_maps(first(filter.link))]
    chains = [memory for memory in memories if isinstance(memory, MarkovChain)]
    if chains:
        chain = chains[0]
        varies = np.ndim(chain.transition) > 2  # a transition matrix for each step
        if len(memories) > 1 or chain.is_uncertain or varies:
            raise fail("numbers told", "one chain alone, of known probabilities", f"{len(memories)} maps")
        return _list_numbers_of_chain(chain)
    # All combinations so far with each number of the next map: rows of `values`; their weights are products.
    values, weights = np.zeros((1, 0)), np.ones(1)
    for memory in memories:
        more, chances = _find_quadrature(memory)
        if len(values) * len(more) > MOST:
            raise fail("numbers told", f"at most {MOST} combinations of nodes", len(values) * len(more))
        values = np.concatenate([np.repeat(values, len(more), axis=0), np.tile(more, (len(values), 1))], axis=1)
        weights = np.outer(weights, chances).ravel()
    return ToldNumbersByMode(
        numbers=values[None], weights=weights[None], initial=np.ones(1), transition=np.ones((1, 1))
    )


def _list_numbers_of_chain(chain: MarkovChain) -> ToldNumbersByMode:
    """Return the numbers that messages report of a chain's mode: in mode i the number i, with weight 1."""
    numbers = np.arange(float(chain.modes))[:, None, None]  # (modes, nodes, told), one node and one number
    return ToldNumbersByMode(
        numbers=numbers,
        weights=np.ones((chain.modes, 1)),
        initial=np.asarray(chain.initial),
        transition=np.asarray(chain.transition),
    )


def _find_quadrature(memory: AbstractMemory) -> tuple[Float[np.ndarray, "nodes told"], Float[np.ndarray, " nodes"]]:
    """Return values (nodes, told) of numbers that are drawn anew at each step, with their probabilities (nodes,).

    Each message reports a reading of a gain, one gain itself, or one of finitely many values. Laws with a density are
    replaced by the nodes and weights of Gauss's quadrature.
    """
    if isinstance(memory, FreshReading):
        return reading_quadrature(memory.law, float(memory.variance))
    if isinstance(memory, FreshNumbers) and isinstance(memory.law, AbstractLaw) and memory.count == 1:
        return gain_quadrature(memory.law)
    if isinstance(memory, FreshNumbers) and isinstance(memory.law, FiniteSupport):
        return np.asarray(memory.law.atoms), np.asarray(memory.law.probabilities)
    law = memory.law if isinstance(memory, FreshNumbers) else memory
    raise fail("numbers told", "a law of one gain or of finitely many values", type(law).__name__)
