"""Contract tests of a fusion rule (same estimates, claims, its bound) and of a quantizer (error bound, state)."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.quantizer import AbstractQuantizer, Quantized
from heliograph.fusion.rules import AbstractFusion, fuse
from heliograph.model.estimate import STRENGTH, Claim, Estimate
from heliograph.numerics.types import Array
from heliograph.testing.filter_contract import ROUNDING

SEARCHED = 1e-6  # relative: a flat minimum fixes weights that are searched for to the root of rounding, 1e-8
DRAWS = 10  # joint covariances on which a rule is tested
STARTS, ASCENTS = 8, 50  # of the search for the worst direction: ascents, and steps of each


def check_fusion(rule: AbstractFusion, count: int = 3, n: int = 2, seed: int = 0) -> None:
    """Check a fusion rule on random estimates.

    Identical estimates are returned unchanged; a claim is no stronger than the weakest input's; fusion inside vmap
    equals fusion alone; and where "upper" is claimed, the fused covariance dominates that of the fused error for every
    joint covariance of the inputs' errors: a random one, and the worst that an ascent over directions finds.

    Args:
        rule: the rule to test.
        count: number of estimates (default 3).
        n: number of states (default 2).
        seed: seed of the covariances (default 0).

    Raises:
        AssertionError: naming the rule that is broken.
    """
    generator = np.random.default_rng(seed)
    claims: list[Claim] = ["exact", "upper", "nominal"]
    others: list[Claim] = ["exact"] * (count - 1)
    for claim in claims:
        fused = rule.claim([claim, *others])
        assert STRENGTH[fused] <= STRENGTH[claim], f"claim: expected at most {claim!r}, got {fused!r}"
    for _ in range(DRAWS):
        # A joint covariance of the errors, (input, state, input, state), whose blocks on the diagonal are the bounds.
        root = generator.normal(size=(count * n, count * n))
        joint = (root @ root.T).reshape(count, n, count, n)
        bounds = np.stack([joint[i, :, i] for i in range(count)])
        alike = _fuse_bounds(rule, np.ones((count, n)), np.broadcast_to(bounds[0], bounds.shape))
        _check_close("identical estimates", alike.mean, np.ones(n))
        _check_close("identical bounds", alike.covariance, bounds[0])
        # The fused mean is linear in the inputs' means: sum_i W_i mean_i. So sets of means in which one number is 1 and
        # all others are 0 give the columns of the gains W = (W_1, W_2, ...), (n, count n), when fused in a vmap.
        unit_sets = np.eye(count * n).reshape(count * n, count, n)
        unit_means = np.moveaxis(unit_sets, 1, 0)  # (input, set, state): inputs first, as `fuse` takes them
        together = _fuse_bounds(rule, unit_means, np.broadcast_to(bounds[:, None], (count, count * n, n, n)))
        _check_close("fusing inside vmap", together.mean[0], _fuse_bounds(rule, unit_means[:, 0], bounds).mean)
        gains = np.asarray(together.mean).T
        # An upper bound holds where the fused error's covariance less it has no eigenvalue above zero.
        if rule.claim(["upper"] * count) == "upper":
            claimed = np.asarray(together.covariance[0])  # alike in all sets, as it does not depend on means
            excess = gains @ joint.reshape(count * n, count * n) @ gains.T - claimed
            worst = max(np.linalg.eigvalsh(excess)[-1], _find_worst_excess(gains, bounds, claimed, generator))
            limit = ROUNDING * np.trace(claimed)
            assert worst <= limit, f"bound: expected an upper one, exceeded by {worst:g}"


def _find_worst_excess(
    gains: np.ndarray, bounds: np.ndarray, claimed: np.ndarray, generator: np.random.Generator
) -> float:
    """Return the largest v' (E - B) v found over unit directions v and all joint covariances of the errors.

    The fused error is sum_i W_i e_i, the covariance of e_i is at most P_i, and E is that of the fused error. The worst
    is sup v' E v = (sum_i |P_i^(1/2) W_i' v|)^2, where all errors move together. Its root is convex in v, so that
    v <- B^+ grad, with the gradient of the root, ascends the ratio to v' B v at each step; ASCENTS steps, STARTS times.

    Args:
        gains: W_1, W_2, ... side by side (n, count n).
        bounds: P_i (count, n, n).
        claimed: B (n, n).
        generator: draws the directions from which the ascents begin.
    """
    weighted_bounds = [W @ P @ W.T for W, P in zip(np.split(gains, len(bounds), axis=1), bounds, strict=True)]
    inverse_of_B, worst = np.linalg.pinv(claimed), -np.inf
    for v in generator.normal(size=(STARTS, len(claimed))):
        for _ in range(ASCENTS):
            v = v / np.linalg.norm(v)
            deviations = [np.sqrt(v @ bound @ v) for bound in weighted_bounds]
            worst = max(worst, float(sum(deviations) ** 2 - v @ claimed @ v))
            pairs = zip(weighted_bounds, deviations, strict=True)
            gradient = sum(bound @ v / deviation for bound, deviation in pairs if deviation > 0)
            next_v = inverse_of_B @ gradient
            v = next_v if np.linalg.norm(next_v) > 0 else v
    return worst


def _fuse_bounds(rule: AbstractFusion, means: np.ndarray, bounds: np.ndarray) -> Estimate:
    """Return the fusion of estimates with these means and upper bounds, along their first axes."""
    return fuse(rule, [Estimate(m, b, "upper") for m, b in zip(means, bounds, strict=True)])


def _check_close(what: str, got: Array, expected: Array) -> None:
    """Raise AssertionError unless arrays are equal to the digits that a search for weights has."""
    gap = np.abs(np.asarray(got) - expected).max()
    assert gap <= SEARCHED * np.abs(expected).max(), f"{what}: expected the same back, off by {gap:g}"


def check_quantizer(quantizer: AbstractQuantizer, n: int = 2, steps: int = 20, seed: int = 0) -> None:
    """Check (init, step) of a quantizer on random values, some far out of range, some NaN.

    The stated error bound holds, and is NaN where a component is saturated or NaN; a value that was delivered
    unsaturated is delivered again from the same state; a step is deterministic, preserves the structure of the state,
    and does the same under jit and vmap.

    Args:
        quantizer: the quantizer to test.
        n: number of components (default 2).
        steps: number of values (default 20).
        seed: seed of the values (default 0).

    Raises:
        AssertionError: naming the rule that is broken.
    """
    with jax.enable_x64(True):
        _check_quantizer_steps(quantizer, n, steps, np.random.default_rng(seed))


def _check_quantizer_steps(quantizer: AbstractQuantizer, n: int, steps: int, generator: np.random.Generator) -> None:
    """Check a quantizer Q on random values (n,), each of which follows the last from the state that it left.

    A quantizer rounds what a node sends, and states how large the error of each component may be; its state may change
    from message to message. Checked are that the delivered value has the stated error, that Q(Q(x)) = Q(x) from the
    same state, and that Q does the same under jit and vmap.

    Raises:
        AssertionError: naming the rule that is broken.
    """
    state = quantizer.init(n)
    structure, in_vmap = str(jax.tree.structure(state)), jax.jit(jax.vmap(quantizer.step))
    for k in range(steps):
        # Values over seven decades, some components NaN.
        value = generator.normal(size=n) * 10.0 ** generator.integers(-3, 4, size=n)
        value[generator.random(n) < 0.1] = np.nan
        next_state, sent = quantizer.step(state, value)
        assert str(jax.tree.structure(next_state)) == structure, "step: expected a state of init's structure"
        _check_quantized(sent, value, n)
        # Q(Q(x)) = Q(x) where a component is not saturated: there its error is finite.
        again = np.asarray(quantizer.step(state, sent.value)[1].value)
        is_unsaturated = np.isfinite(sent.error)
        is_off = np.abs(again - sent.value)[is_unsaturated] > ROUNDING * np.abs(value)[is_unsaturated]
        assert not np.any(is_off), f"step {k}: expected what was delivered to be delivered again"
        # The same compiled, for a batch of two equal states and values.
        batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (state, jnp.asarray(value)))
        _, twice = in_vmap(*batch)
        for name, delivered in sent._asdict().items():
            both = np.asarray(getattr(twice, name))
            is_same = np.allclose(both, delivered, rtol=ROUNDING, atol=0, equal_nan=True)
            assert is_same, f"step {k}, {name}: expected the same under jit and vmap"
        state = next_state


def _check_quantized(sent: Quantized, value: np.ndarray, n: int) -> None:
    """Check that what a quantizer delivers has the right shape, NaN in the right places, and keeps its bound."""
    assert all(np.shape(field) == (n,) for field in sent), f"step: expected parts of shape ({n},)"
    has_no_bound = np.asarray(sent.saturated) | np.isnan(value)
    expectation = "error: expected NaN where saturated or NaN, and only there"
    assert np.array_equal(np.isnan(sent.error), has_no_bound), expectation
    assert np.array_equal(np.isnan(sent.value), np.isnan(value)), "value: expected NaN for NaN, and only there"
    assert np.all(np.asarray(sent.symbols) >= 1), "symbols: expected at least one"
    excess = (np.abs(sent.value - value) - sent.error * (1 + ROUNDING))[~has_no_bound]
    assert np.all(excess <= 0), f"error: expected a bound, exceeded by {excess.max(initial=0.0):g}"
