"""Contract test of a filter: sizes, claim, and a step that is its prediction and its correction."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compute_once
from heliograph.filters.base import AbstractFilter
from heliograph.model.estimate import STRENGTH, Estimate, Innovation
from heliograph.numerics.check import standard_deviations
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import ArrayLike, PyTree
from heliograph.simulation.likelihood import log_likelihood

ROUNDING = 1e-9  # relative: far above what a few operations lose, far below what a wrong formula gains
MISSING = 0.3  # share of the components that do not arrive


def check_filter(filter: AbstractFilter, inputs: ArrayLike = (), steps: int = 5, seed: int = 0) -> None:
    """Check the contract of a filter on random measurements, with the same inputs at each step.

    The filter must state its sizes and its claim (what its covariance is said to be: exact, a bound, nominal or none),
    and refuse a measurement or input of another size. A step must equal prediction and correction, be deterministic,
    preserve the structure of the state, and do the same inside vmap. It must return a finite mean and a symmetric
    positive semidefinite covariance (NaN if it claims none), also if some or all components are missing. An innovation
    must be NaN where a component is missing. The log-likelihood must be finite unless no covariance is claimed, 0 if
    nothing arrived, and in a run the sum over the steps.

    Args:
        filter: the filter to test.
        inputs: the plant's inputs, shape (inputs,); by default none.
        steps: number of steps (default 5).
        seed: seed of the measurements (default 0).

    Raises:
        AssertionError: naming the rule that is broken.
    """
    _check_sizes(filter, inputs)
    # Measurements: the first complete, then some components missing, the last with all missing.
    data = np.random.default_rng(seed).normal(size=(steps, filter.received))
    data[1:][np.random.default_rng(seed + 1).random(data[1:].shape) < MISSING] = np.nan
    data[-1] = np.nan
    u = np.broadcast_to(np.asarray(inputs, dtype=float), (steps, len(filter.inputs)))
    state, total = filter.init(), 0.0
    for k, z in enumerate(data):
        state, log_density = _check_step(filter, state, z, u[k], k)
        total += log_density
    # log p(z_1, ..., z_N) = sum of the innovations' log-likelihoods; both are NaN where no covariance is claimed.
    whole = float(log_likelihood(filter, data, u))
    is_sum = abs(whole - total) <= ROUNDING * (1 + abs(total)) or bool(np.isnan(whole) and np.isnan(total))
    assert is_sum, f"log_likelihood: expected the sum over the steps {total:g}, got {whole:g}"


def _check_step(filter: AbstractFilter, state: PyTree, z: np.ndarray, u: np.ndarray, k: int) -> tuple[PyTree, float]:
    """Check one step of a filter from a state; return the state after it, and the innovation's log-likelihood.

    The step is computed twice, each time in three ways: as a step, as a prediction and a correction, inside vmap.

    Raises:
        AssertionError: naming the rule that is broken.
    """
    arguments = filter, state, z, u, np.asarray(k)
    once, again = (compute_once(_list_ways_to_step, _list_ways_to_step_by_xla, arguments) for _ in range(2))
    (stepped, estimate), (corrected, estimate_of_parts, innovation), means_in_vmap = once
    (_, estimate_again), *_ = again
    is_same = np.array_equal(estimate.mean, estimate_again.mean)
    assert is_same, "step: expected the same estimate from the same arguments"
    structure = str(jax.tree.structure(filter.init()))
    for after in (stepped, corrected):
        assert str(jax.tree.structure(after)) == structure, "step: expected a state of init's structure"
    _check_estimate(estimate, len(filter.states), k)
    _check_same(f"step {k}: the prediction, corrected", estimate_of_parts, estimate)
    _check_innovation(innovation, z, filter, k)
    gap = np.abs(means_in_vmap - estimate.mean).max()
    scale = 1 + np.abs(estimate.mean).max()
    assert gap <= ROUNDING * scale, f"step {k}: expected the same estimate inside vmap, off by {gap:g}"
    return stepped, float(innovation.log_likelihood)


def _step_filter(filter: AbstractFilter, state: PyTree, z: PyTree, u: PyTree, k: PyTree) -> tuple[PyTree, Estimate]:
    """Return state and estimate after one step k of the filter, with measurement z and inputs u."""
    return filter.step(state, z, u, k)


def _predict_and_correct(
    filter: AbstractFilter, state: PyTree, z: PyTree, u: PyTree, k: PyTree
) -> tuple[PyTree, Estimate, Innovation]:
    """Return state, estimate and innovation after a prediction with inputs u and a correction by z, in step k."""
    predicted = filter.predict(state, u, k)
    corrected, innovation = filter.correct(predicted, z, k)
    return corrected, filter.estimate(corrected), innovation


def _step_in_vmap(filter: AbstractFilter, state: PyTree, z: PyTree, u: PyTree, k: PyTree) -> PyTree:
    """Return the means (2, n) after step k of two filters side by side (`vmap`), of equal states and measurements."""
    twice = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (state, z))
    return jax.vmap(lambda s, z: filter.step(s, z, u, k)[1].mean)(*twice)


def _list_ways_to_step(*arguments: PyTree) -> tuple[PyTree, ...]:
    """Return the results of a step in three ways: as a step, as its prediction and correction, and within `vmap`.

    Native code of all three together computes once what they have in common.
    """
    return _step_filter(*arguments), _predict_and_correct(*arguments), _step_in_vmap(*arguments)


# By XLA three programs: one of all three is more than thrice as much work for its optimiser.
_ways_by_xla = tuple(map(compile_in_float64, (_step_filter, _predict_and_correct, _step_in_vmap)))


def _list_ways_to_step_by_xla(*arguments: PyTree) -> tuple[PyTree, ...]:
    """Return the results of a step in the same three ways, each compiled by XLA by itself."""
    return tuple(way(*arguments) for way in _ways_by_xla)


def _check_sizes(filter: AbstractFilter, inputs: ArrayLike) -> None:
    """Check that a filter has a claim and names, and refuses measurements, inputs and steps that do not fit it.

    `inputs`: inputs of the plant over one step (inputs,).

    Raises:
        AssertionError: naming what is broken.
    """
    assert filter.claim in STRENGTH, f"claim: expected one of {list(STRENGTH)}, got {filter.claim!r}"
    assert filter.states and len(set(filter.states)) == len(filter.states), "states: expected distinct names"
    assert filter.received >= 0, "received: expected a length"
    # Calls with wrong sizes, a step before the first, or infinite values; each with the name of the argument with which
    # the error has to begin.
    state, fitting = filter.init(), np.zeros(filter.received)
    wrong: list[tuple[str, Callable[[], object]]] = [
        ("inputs", lambda: filter.predict(state, np.zeros(len(filter.inputs) + 1))),
        ("step", lambda: filter.step(state, fitting, inputs, -1)),
    ]
    if filter.received:
        longer, infinite = np.zeros(filter.received + 1), np.full(filter.received, np.inf)
        wrong += [
            ("measurement", lambda: filter.correct(state, longer)),
            ("measurement", lambda: filter.step(state, infinite, inputs)),
            ("measurement", lambda: filter.step(state, longer, inputs)),
        ]
    for name, call in wrong:
        try:
            call()
        except ValueError as error:
            assert str(error).startswith(name), f"{name}: expected an error that names it, got {error}"
        else:
            raise AssertionError(f"{name}: expected a refusal of what does not fit (@predicts and @corrects do)")


def _check_estimate(estimate: Estimate, n: int, k: int) -> None:
    """Check that an estimate has its shape, finite numbers, and a positive semidefinite covariance if it claims one."""
    mean, bound = np.asarray(estimate.mean), np.asarray(estimate.covariance)
    assert mean.shape == (n,), f"step {k}: expected a mean of shape {(n,)}, got {mean.shape}"
    assert bound.shape == (n, n), f"step {k}: expected a covariance of shape {(n, n)}, got {bound.shape}"
    assert np.all(np.isfinite(mean)), f"step {k}: expected a finite mean"
    if estimate.claim == "none":
        assert np.all(np.isnan(bound)), f"step {k}: expected a covariance of NaN, since none is claimed"
        return
    assert np.all(np.isfinite(bound)), f"step {k}: expected a finite covariance"
    unit = standard_deviations(bound)
    correlations = bound / np.outer(unit, unit)
    assert np.abs(correlations - correlations.T).max() <= ROUNDING, f"step {k}: expected a symmetric covariance"
    smallest = np.linalg.eigvalsh((correlations + correlations.T) / 2)[0]
    expected = f"step {k}: expected a positive semidefinite covariance"
    assert smallest >= -ROUNDING, f"{expected}, smallest eigenvalue of correlations {smallest:g}"


def _check_innovation(innovation: Innovation, z: np.ndarray, filter: AbstractFilter, k: int) -> None:
    """Check that an innovation is NaN exactly where nothing arrived, and that its likelihood agrees with that."""
    m, missing, likelihood = len(z), np.isnan(z), float(innovation.log_likelihood)
    value, covariance = np.asarray(innovation.value), np.asarray(innovation.covariance)
    assert value.shape == (m,) and covariance.shape == (m, m), f"step {k}: expected an innovation of {m} components"
    assert np.array_equal(np.isnan(value), missing), f"step {k}: expected an innovation of NaN where z is, only there"
    # If a sender decides when to send, silence has a likelihood too.
    if np.all(missing) and filter.silence_tells:
        assert np.isfinite(likelihood), f"step {k}: expected a finite log-likelihood of silence, got {likelihood:g}"
    elif np.all(missing):
        assert likelihood == 0, f"step {k}: expected a log-likelihood of 0 where nothing arrived, got {likelihood:g}"
    elif filter.claim != "none":
        assert np.isfinite(likelihood), f"step {k}: expected a finite log-likelihood, got {likelihood:g}"
        unknown = missing[:, None] | missing
        assert np.array_equal(np.isnan(covariance), unknown), f"step {k}: expected a covariance where z arrived"


def _check_same(what: str, estimate: Estimate, expected: Estimate) -> None:
    """Raise AssertionError unless two estimates are equal up to rounding.

    ROUNDING is the allowed relative difference. `what` names the operation in the error.
    """
    for name in ("mean", "covariance"):
        a, b = np.asarray(getattr(estimate, name)), np.asarray(getattr(expected, name))
        same = np.allclose(a, b, rtol=ROUNDING, atol=ROUNDING * np.nanmax(np.abs(b), initial=0.0), equal_nan=True)
        assert same, f"{what}: expected the {name} of step"
