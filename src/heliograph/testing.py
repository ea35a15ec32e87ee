"""Contract checks for your own channels, filters, quantizers and fusion rules; they raise AssertionError."""

from collections.abc import Callable
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from heliograph.filters.base import AbstractFilter
from heliograph.fusion.quantizer import AbstractQuantizer
from heliograph.fusion.rules import AbstractFusion, fuse
from heliograph.model.estimate import STRENGTH, Claim, Estimate, Innovation
from heliograph.numerics.check import own_units
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.base import AbstractRandomAffine, memories
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.monomials import monomials
from heliograph.simulation.likelihood import log_likelihood
from heliograph.simulation.scaling import check_scaling as check_scaling

ROUNDING = 1e-9  # relative: far above what a few operations lose, far below what a wrong formula gains
SEARCHED = 1e-6  # relative: a flat minimum fixes weights that are searched for to the root of rounding, 1e-8
FALSE_ALARM = 1e-6  # probability that a correct object fails, shared by all numbers compared (Bonferroni)


def check_random_affine(channel: AbstractRandomAffine, seed: int = 0, samples: int = 20_000, highest: int = 4) -> float:
    """Compare a channel's samples with its joint moments, E[mono_k(z) | y] for k = 1 .. highest, at two points y.

    Returns the largest |z| seen. Wrong moments of size s are found when s exceeds about 6 standard errors, so more
    samples make it stricter. Of a map with modes two draws are taken one after the other: their moments are compared
    under the modes' laws, and together E[H_1 x H_2] and E[mono_i(z_1) mono_j(z_2)] for i, j = 1 .. highest / 2, which a
    wrong transition changes.
    Of a map that remembers in a way of its own, which has no such moments, only `init` and `draw` are checked: a state
    that keeps its structure and shapes.

    Raises:
        AssertionError: a moment that differs from the samples by more than chance, shapes that disagree.
    """
    generator = np.random.default_rng(seed)
    first, second = _drawn(channel, seed, samples)
    points = [channel.example_input(generator), channel.example_input(generator)]
    if channel.remembers:
        if not memories(channel):
            return 0.0
        modes = joint_modes(channel, order=-(-highest // 2))
        now, later = (h[:, :-1] @ np.append(y, 1.0) for h, y in zip((first, second), points, strict=True))
        worst = _compare_lagged(modes, first[:, :-1], second[:, :-1])
        return max(worst, _compare_modes(modes, points, now, later, highest))
    worst = 0.0
    for y in points:
        z = first[:, :-1] @ np.append(y, 1.0)
        for order in range(1, highest + 1):
            expected = channel.moments(order).expect(monomials(y, order))
            worst = max(worst, _compare(f"order {order}", expected, _monomials(z, order)))
    return worst


def _compare_lagged(modes: JointModes, now: np.ndarray, later: np.ndarray) -> float:
    """E[(G, n)_1 x (G, n)_2] of two draws in a row."""
    means = np.array([m.moments(1).mean[:-1] for m in modes.maps])
    expected = np.einsum("i,ij,iab,jcd->abcd", modes.initial, modes.transition, means, means)
    seen = np.einsum("sab,scd->sabcd", now, later)
    return _compare("two draws in a row", expected.reshape(-1), seen.reshape(len(now), -1))


def _compare_modes(
    modes: JointModes, points: list[np.ndarray], now: np.ndarray, later: np.ndarray, highest: int
) -> float:
    """Moments of two draws in a row, each and together."""
    begin, rows, worst = np.asarray(modes.initial), np.asarray(modes.transition), 0.0
    given = {
        order: [modes.moments(order) @ monomials(y, order) for y in points] for order in range(1, highest + 1)
    }  # E[mono(z) | mode], (mode, monomials)
    for order, (one, two) in given.items():
        worst = max(worst, _compare(f"order {order}, first draw", begin @ one, _monomials(now, order)))
        worst = max(worst, _compare(f"order {order}, second draw", begin @ rows @ two, _monomials(later, order)))
    for i, j in product(range(1, highest // 2 + 1), repeat=2):
        expected = np.einsum("a,ab,am,bl->ml", begin, rows, given[i][0], given[j][1]).reshape(-1)
        seen = np.einsum("sm,sl->sml", _monomials(now, i), _monomials(later, j)).reshape(len(now), -1)
        worst = max(worst, _compare(f"orders {i} and {j} of two draws in a row", expected, seen))
    return worst


def _drawn(channel: AbstractRandomAffine, seed: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """First and second draws of H, after the contract of `init`, `draw` and `sample` was checked."""

    def two_steps(key: jax.Array) -> Any:
        start = channel.init(jax.random.fold_in(key, 2))
        state, h = channel.draw(start, key)
        sampled = () if channel.remembers else channel.sample(key)
        return start, state, h, *channel.draw(state, jax.random.fold_in(key, 1)), sampled

    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(seed), samples)
        start, state, h, following, later, sampled = jax.jit(jax.vmap(two_steps))(keys)
        assert channel.remembers or start == (), f"init: expected () of a map that forgets, got {start}"
        shapes = [jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), s) for s in (start, state, following)]
        assert shapes[0] == shapes[1] == shapes[2], f"draw: expected a state like init's {shapes[0]}, got {shapes[1]}"
        same = channel.remembers or np.array_equal(h, sampled, equal_nan=True)
        assert same, "draw: expected what sample draws from the same key"
    drawn = np.asarray(h)
    expected_shape = (samples, channel.outputs + 1, channel.inputs + 1)
    assert drawn.shape == expected_shape, f"draw: expected shape {expected_shape[1:]}, got {drawn.shape[1:]}"
    bottom = np.eye(1, channel.inputs + 1, channel.inputs)
    assert np.array_equal(drawn[:, -1:], np.broadcast_to(bottom, drawn[:, -1:].shape)), "last row: expected [0, 1]"
    return drawn, np.asarray(later)


def _monomials(z: np.ndarray, order: int) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(jax.vmap(lambda row: monomials(row, order))(jnp.asarray(z)))


def _compare(what: str, expected: np.ndarray | jax.Array, seen: np.ndarray) -> float:
    """Means over samples (sample, number) against what is expected; the largest ratio to the standard error."""
    error = seen.std(axis=0) / np.sqrt(len(seen))
    difference = np.abs(seen.mean(axis=0) - expected)
    scale = np.abs(seen).max(axis=0) + np.abs(expected)
    certain = error <= 1e-12 * scale  # the monomial does not vary: moments must agree to rounding
    assert np.all(difference[certain] <= 1e-9 * scale[certain]), f"{what}: a known moment differs"
    ratios = difference[~certain] / error[~certain]
    limit = float(stats.norm.isf(FALSE_ALARM / 2 / max(len(ratios), 1)))
    largest = float(ratios.max(initial=0.0))
    assert largest <= limit, f"{what}: a moment differs from the samples by {largest:.1f} standard errors"
    return largest


def check_filter(item: AbstractFilter, inputs: ArrayLike = (), steps: int = 5, seed: int = 0) -> None:
    """Check the contract of a filter on random measurements, with the same inputs at each step.

    Its claim and sizes are stated, and a measurement or input of another size is refused. A step is its prediction and
    correction; is deterministic; leaves the structure of the state alone; gives a finite mean and a symmetric positive
    semidefinite covariance (NaN if it claims none), also when some or all components are missing; and does the same
    inside vmap. An innovation is NaN where a component is missing; its log-likelihood is finite unless no covariance
    is claimed, 0 where nothing arrived, and `log_likelihood` of a run is the sum.

    Raises:
        AssertionError: naming what does not hold.
    """
    _check_sizes(item, inputs)
    data = np.random.default_rng(seed).normal(size=(steps, item.received))
    data[1:][np.random.default_rng(seed + 1).random(data[1:].shape) < 0.3] = np.nan
    data[-1] = np.nan
    state, total = item.init(), 0.0
    structure = str(jax.tree.structure(state))
    side_by_side = jax.jit(jax.vmap(lambda s, z, k: item.step(s, z, inputs, k)[1].mean, in_axes=(0, 0, None)))
    for k, z in enumerate(data):
        following, estimate = item.step(state, z, inputs, k)
        again = item.step(state, z, inputs, k)[1]
        assert np.array_equal(estimate.mean, again.mean), "step: expected the same estimate from the same arguments"
        corrected, innovation = item.correct(item.predict(state, inputs, k), z, k)
        for part in (following, corrected):
            assert str(jax.tree.structure(part)) == structure, "step: expected a state of init's structure"
        _check_estimate(estimate, len(item.states), k)
        _same(f"step {k}: the prediction, corrected", item.estimate(corrected), estimate)
        _check_innovation(innovation, z, item, k)
        with jax.enable_x64(True):
            twice = np.asarray(side_by_side(*jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (state, z)), k))
        gap = np.abs(twice - estimate.mean).max()
        scale = 1 + np.abs(estimate.mean).max()
        assert gap <= ROUNDING * scale, f"step {k}: expected the same estimate inside vmap, off by {gap:g}"
        state, total = following, total + float(innovation.log_likelihood)
    whole = float(
        log_likelihood(item, data, np.broadcast_to(np.asarray(inputs, dtype=float), (steps, len(item.inputs))))
    )
    same = abs(whole - total) <= ROUNDING * (1 + abs(total)) or bool(np.isnan(whole) and np.isnan(total))
    assert same, f"log_likelihood: expected the sum over the steps {total:g}, got {whole:g}"


def _check_sizes(item: AbstractFilter, inputs: ArrayLike) -> None:
    assert item.claim in STRENGTH, f"claim: expected one of {list(STRENGTH)}, got {item.claim!r}"
    assert item.states and len(set(item.states)) == len(item.states), "states: expected distinct names"
    assert item.received >= 0, "received: expected a length"
    state, fitting = item.init(), np.zeros(item.received)
    wrong: list[tuple[str, Callable[[], Any]]] = [
        ("inputs", lambda: item.predict(state, np.zeros(len(item.inputs) + 1)))
    ]
    if item.received:
        longer = np.zeros(item.received + 1)
        wrong.append(("measurement", lambda: item.correct(item.predict(state, inputs), longer)))
        wrong.append(("measurement", lambda: item.step(state, np.full(item.received, np.inf), inputs)))
        wrong.append(("measurement", lambda: item.step(state, longer, inputs)))
    wrong.append(("step", lambda: item.step(state, fitting, inputs, -1)))
    for name, call in wrong:
        try:
            call()
        except ValueError as error:
            assert str(error).startswith(name), f"{name}: expected an error that names it, got {error}"
        else:
            raise AssertionError(f"{name}: expected a refusal of what does not fit (@predicts and @corrects do)")


def _check_estimate(estimate: Estimate, n: int, k: int) -> None:
    mean, bound = np.asarray(estimate.mean), np.asarray(estimate.covariance)
    assert mean.shape == (n,), f"step {k}: expected a mean of shape {(n,)}, got {mean.shape}"
    assert bound.shape == (n, n), f"step {k}: expected a covariance of shape {(n, n)}, got {bound.shape}"
    assert np.all(np.isfinite(mean)), f"step {k}: expected a finite mean"
    if estimate.claim == "none":
        assert np.all(np.isnan(bound)), f"step {k}: expected a covariance of NaN, since none is claimed"
        return
    assert np.all(np.isfinite(bound)), f"step {k}: expected a finite covariance"
    unit = own_units(bound)
    correlations = bound / np.outer(unit, unit)
    assert np.abs(correlations - correlations.T).max() <= ROUNDING, f"step {k}: expected a symmetric covariance"
    smallest = np.linalg.eigvalsh((correlations + correlations.T) / 2)[0]
    assert smallest >= -ROUNDING, (
        f"step {k}: expected a positive semidefinite covariance, smallest eigenvalue of correlations {smallest:g}"
    )


def _check_innovation(innovation: Innovation, z: np.ndarray, item: AbstractFilter, k: int) -> None:
    m, missing, likelihood = len(z), np.isnan(z), float(innovation.log_likelihood)
    value, covariance = np.asarray(innovation.value), np.asarray(innovation.covariance)
    assert value.shape == (m,) and covariance.shape == (m, m), f"step {k}: expected an innovation of {m} components"
    assert np.array_equal(np.isnan(value), missing), f"step {k}: expected an innovation of NaN where z is, only there"
    if np.all(missing):
        assert likelihood == 0, f"step {k}: expected a log-likelihood of 0 where nothing arrived, got {likelihood:g}"
    elif item.claim != "none":
        assert np.isfinite(likelihood), f"step {k}: expected a finite log-likelihood, got {likelihood:g}"
        unknown = missing[:, None] | missing
        assert np.array_equal(np.isnan(covariance), unknown), f"step {k}: expected a covariance where z arrived"


def _same(what: str, found: Estimate, expected: Estimate) -> None:
    for name in ("mean", "covariance"):
        a, b = np.asarray(getattr(found, name)), np.asarray(getattr(expected, name))
        same = np.allclose(a, b, rtol=ROUNDING, atol=ROUNDING * np.nanmax(np.abs(b), initial=0.0), equal_nan=True)
        assert same, f"{what}: expected the {name} of step"


def check_quantizer(quantizer: AbstractQuantizer, n: int = 2, steps: int = 20, seed: int = 0) -> None:
    """Check the (init, step) contract on random values of n components, some far out of reach, some NaN.

    The stated error bound holds, and is NaN where a component is saturated or NaN; what was delivered unsaturated is
    delivered again from the same state; a step is deterministic, leaves the structure of the state alone, and does the
    same under jit and vmap.

    Raises:
        AssertionError: naming what does not hold.
    """
    generator = np.random.default_rng(seed)
    state = quantizer.init(n)
    structure, compiled = str(jax.tree.structure(state)), jax.jit(jax.vmap(quantizer.step))
    for k in range(steps):
        value = generator.normal(size=n) * 10.0 ** generator.integers(-3, 4, size=n)
        value[generator.random(n) < 0.1] = np.nan
        following, sent = quantizer.step(state, value)
        assert str(jax.tree.structure(following)) == structure, "step: expected a state of init's structure"
        _check_quantized(sent, value, n)
        again = np.asarray(quantizer.step(state, sent.value)[1].value)
        usable = np.isfinite(sent.error)
        off = np.abs(again - sent.value)[usable] > ROUNDING * np.abs(value)[usable]
        assert not np.any(off), f"step {k}: expected what was delivered to be delivered again"
        with jax.enable_x64(True):
            batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (state, jnp.asarray(value)))
            _, twice = compiled(*batch)
        for name, one in sent._asdict().items():
            both = np.asarray(getattr(twice, name))
            same = np.allclose(both, one, rtol=ROUNDING, atol=0, equal_nan=True)
            assert same, f"step {k}, {name}: expected the same under jit and vmap"
        state = following


def _check_quantized(sent: Any, value: np.ndarray, n: int) -> None:
    assert all(np.shape(part) == (n,) for part in sent), f"step: expected parts of shape ({n},)"
    unusable = np.asarray(sent.saturated) | np.isnan(value)
    assert np.array_equal(np.isnan(sent.error), unusable), "error: expected NaN where saturated or NaN, and only there"
    assert np.array_equal(np.isnan(sent.value), np.isnan(value)), "value: expected NaN for NaN, and only there"
    assert np.all(np.asarray(sent.symbols) >= 1), "symbols: expected at least one"
    excess = (np.abs(sent.value - value) - sent.error * (1 + ROUNDING))[~unusable]
    assert np.all(excess <= 0), f"error: expected a bound, exceeded by {excess.max(initial=0.0):g}"


def check_fusion(rule: AbstractFusion, count: int = 3, n: int = 2, seed: int = 0) -> None:
    """Check a rule on random estimates, `count` of them with n components.

    Identical estimates give themselves back; a claim is no stronger than the weakest input's; fusing inside vmap is
    fusing alone; and where "upper" is claimed, the bound dominates the fused error's covariance for random joint
    covariances of the inputs' errors.

    Raises:
        AssertionError: naming what does not hold.
    """
    generator = np.random.default_rng(seed)
    claims: list[Claim] = ["exact", "upper", "nominal"]
    for claim in claims:
        fused = rule.claim([claim, *claims[:1] * (count - 1)])
        assert STRENGTH[fused] <= STRENGTH[claim], f"claim: expected at most {claim!r}, got {fused!r}"
    for _ in range(10):
        root = generator.normal(size=(count * n, count * n))
        joint = (root @ root.T).reshape(count, n, count, n)
        bounds = np.stack([joint[i, :, i] for i in range(count)])
        alike = _fused(rule, np.ones((count, n)), np.broadcast_to(bounds[0], bounds.shape))
        _close("identical estimates", alike.mean, np.ones(n))
        _close("identical bounds", alike.covariance, bounds[0])
        # The mean is linear in the means, so unit means give the gain of each input.
        units = np.moveaxis(np.eye(count * n).reshape(count * n, count, n), 1, 0)
        together = _fused(rule, units, np.broadcast_to(bounds[:, None], (count, count * n, n, n)))
        _close("fusing inside vmap", together.mean[0], _fused(rule, units[:, 0], bounds).mean)
        gains = np.asarray(together.mean).T
        if rule.claim(["upper"] * count) == "upper":
            excess = gains @ joint.reshape(count * n, count * n) @ gains.T - together.covariance[0]
            worst = np.linalg.eigvalsh(excess)[-1]
            limit = ROUNDING * np.trace(together.covariance[0])
            assert worst <= limit, f"bound: expected an upper one, exceeded by {worst:g}"


def _fused(rule: AbstractFusion, means: np.ndarray, bounds: np.ndarray) -> Estimate:
    return fuse(rule, [Estimate(m, b, "upper") for m, b in zip(means, bounds, strict=True)])


def _close(what: str, found: Any, expected: Any) -> None:
    gap = np.abs(np.asarray(found) - expected).max()
    assert gap <= SEARCHED * np.abs(expected).max(), f"{what}: expected the same back, off by {gap:g}"
