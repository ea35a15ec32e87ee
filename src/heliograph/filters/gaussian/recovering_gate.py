"""A gate that recovers from locking out: it adopts an alternative estimate that uses what it has rejected for long.

In names, the rival is this alternative estimate, the gate refuses a number that it rejects, and it gives in when it
adopts the rival.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns, join_columns
from heliograph.factors.factored_gaussian import Gaussian, from_columns
from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    make_sizes,
    predicts,
)
from heliograph.filters.gaussian.robust import Gate, RobustFilter
from heliograph.filters.gaussian.robust_scores import PredictedMeasurement
from heliograph.filters.remark import Remark
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import at
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.angles.angle import wrap_near
from heliograph.numerics.check import fail
from heliograph.numerics.types import ArrayLike, Float

CONTRADICTED = float(np.log(1000.0))  # log likelihood ratio at which the other numbers rule the rival out, 1000 to 1
NEVER = -1.0  # stands for the step at which the gate last gave in, if it never did


class GateAndRival(NamedTuple):
    """The estimate of a gate, and the rival: an alternative estimate that also uses the numbers which the gate refuses.

    Args:
        believed: the estimate of the gate.
        rival: the alternative estimate; equal to `believed` while no number is refused.
        refused: how often in a row each received number was refused (m,).
        elapsed: time since the first of these refusals; 0 if the plant has no input dt.
        evidence: log likelihood of the numbers that are not refused, under the rival minus that under the gate.
        given_in: how often the gate has adopted the rival.
        step: step at which it last did, -1 if it never did.
        moved: change of each state then, from the gate's mean to the rival's (n,).
    """

    believed: Gaussian
    rival: Gaussian
    refused: Float[jax.Array, " m"]
    elapsed: Float[jax.Array, ""]
    evidence: Float[jax.Array, ""]
    given_in: Float[jax.Array, ""]
    step: Float[jax.Array, ""]
    moved: Float[jax.Array, " n"]


class GivingInFilter(AbstractSizedFilter):
    """A gate that adopts its rival estimate once it has refused a number for long, unless other numbers contradict.

    From the first refusal on, a second estimate, the rival, runs beside that of the gate, and uses what the gate
    refuses. Let e be the innovation of a refused number, t its noiseless value and V = Var t under the rival. Of all
    changes of the state that explain e, the most probable one is delta = Cov(x, t) e / V. If the gate would refuse e
    under the rival too, the rival's covariance becomes P + n diag(delta^2) / min(c, 1). It is diagonal, since the
    correlations of the n states are as doubtful as their means. By the inequality of Cauchy and Schwarz, Var t grows by
    at least e^2 / min(c, 1), so that e^2 is at most c variances, and e is used.

    Either the sensor is wrong or the gate's state is. The numbers that are not refused decide: `evidence` sums their
    log density under the rival minus that under the gate, at most c / 2 for each. If the rival is right, the sum falls
    to -log 1000 with a probability of at most 1/1000 (a ratio of likelihoods is a martingale); if the sensor is wrong,
    the sum falls the further the longer the rival follows it. After `after` refusals in a row, or `seconds` of them,
    the gate gives in (adopts the rival), unless the sum has fallen so far.

    Args:
        base: the filter with the gate.
        after: number of refusals in a row after which it gives in; None for no such limit.
        seconds: time of refusals in a row after which it gives in; None for no such limit.

    Claim: "nominal".
    Source: Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in
        linear systems (1976), for a jump of the state that is tested beside the filter.
    """

    base: RobustFilter
    after: int | None = eqx.field(static=True)
    seconds: float | None = eqx.field(static=True)

    def angles_used(self) -> FilterAngles:
        """Return the indices of states and of received numbers that are angles: those of the filter with the gate."""
        return self.base.angles_used()

    @compile_on_call
    def init(self) -> GateAndRival:
        """Return the state before any data: gate and rival have the same estimate, and no number is refused.

        `step`, at which the gate last gave in, is NEVER (-1).
        """
        start, zero = self.base.init(), jnp.zeros(())
        return GateAndRival(
            believed=start,
            rival=start,
            refused=jnp.zeros(self.received),
            elapsed=zero,
            evidence=zero,
            given_in=zero,
            step=zero + NEVER,
            moved=jnp.zeros(len(self.states)),
        )

    @predicts
    def predict(self, state: GateAndRival, u: ArrayLike = (), k: Step = 0) -> GateAndRival:
        """Predict the gate's estimate and its rival over step k.

        `elapsed`, the time since the first of the present refusals in a row, grows by the input dt, and is 0 if no
        number is refused.
        """
        elapsed = state.elapsed
        if TIME_STEP in self.inputs:
            time_step = jnp.asarray(u, dtype=float)[self.inputs.index(TIME_STEP)]
            elapsed = jnp.where(jnp.any(state.refused > 0), elapsed + time_step, 0.0)
        believed, rival = (self.base.predict(x, u, k) for x in (state.believed, state.rival))
        return state._replace(believed=believed, rival=rival, elapsed=elapsed)

    @corrects
    def correct(self, state: GateAndRival, z: ArrayLike, k: Step = 0) -> tuple[GateAndRival, Innovation]:
        """Correct the gate's estimate with z (m,), and the rival with all of z; then choose between them.

        A gate is a filter that refuses numbers far from its prediction. If the state jumps, it would refuse all numbers
        for ever; so a second estimate, the rival, also uses the refused ones. The gate gives in, which makes the
        rival's estimate its own, if a number has been refused for long and the numbers that were not refused do not
        contradict the rival.

        Args:
            state: both estimates, how often in a row each number was refused, and the evidence (log-likelihood of the
                numbers that are not refused, under the rival minus that under the gate).
            z: measurement (m,), NaN where missing.
            k: number of the step.
        """
        # The gate's own update, and how often in a row it has refused each number.
        z = jnp.asarray(z)
        arrived = ~jnp.isnan(z)
        after, innovation = self.base.correct(state.believed, z, k)
        left_out = arrived & (jnp.asarray(innovation.weight) < 0.5)  # a gate's weights are 0 and 1
        refused = jnp.where(arrived, jnp.where(left_out, state.refused + 1, 0.0), state.refused)
        suspect = refused > 0
        # The rival: it begins as the gate's estimate. Its prior is widened if it would refuse what the gate refuses.
        prior = _select_tree(jnp.any(state.refused > 0), state.rival, state.believed)
        opened = self._widen_prior(prior, z, left_out, k)
        rival, rival_innovation = self.base.correct(opened, z, k)
        evidence = state.evidence + self._compare_densities(rival_innovation, innovation, arrived & ~suspect)
        # Give in after refusals for long enough, unless the other numbers contradict the rival. The rival ends if the
        # gate gives in, or if no number is refused any more: it then equals the chosen estimate.
        gives_in = self._is_refused_long(refused, state.elapsed) & (evidence > -CONTRADICTED)
        rival_continues = jnp.any(suspect) & ~gives_in
        jump = wrap_near(rival.mean, after.mean, self.angles_used().states) - after.mean
        chosen = _select_tree(gives_in, rival, after)
        belief = GateAndRival(
            believed=chosen,
            rival=_select_tree(rival_continues, rival, chosen),
            refused=jnp.where(gives_in, 0.0, refused),
            elapsed=jnp.where(rival_continues, state.elapsed, 0.0),
            evidence=jnp.where(rival_continues, evidence, 0.0),
            given_in=state.given_in + gives_in,
            step=jnp.where(gives_in, jnp.asarray(k, dtype=float), state.step),
            moved=jnp.where(gives_in, jump, state.moved),
        )
        return belief, _select_tree(gives_in, rival_innovation, innovation)

    def _is_refused_long(self, refused: jax.Array, elapsed: jax.Array) -> jax.Array:
        """Return whether the gate has left out some number often enough in a row, or for long enough, to be doubted.

        `refused` (m,) counts how often in a row each received number was left out, and `elapsed` is the time since the
        first of these. `self.after` and `self.seconds` are the limits that the user gave; None means no limit.
        """
        is_long = jnp.zeros((), dtype=bool)
        if self.after is not None:
            is_long = is_long | jnp.any(refused >= self.after)
        if self.seconds is not None:
            # A single refusal after which nothing arrived is an outlier, however long ago it was.
            is_long = is_long | (jnp.any(refused > 1) & (elapsed >= self.seconds))
        return is_long

    def _widen_prior(self, prior: Gaussian, z: jax.Array, left_out: jax.Array, k: Step) -> Gaussian:
        """Return the rival's prior, with a covariance so large that it can use the numbers that the gate `left_out`.

        The prior P becomes P + n diag(sum delta^2) / min(c, 1). The sum is over the numbers (m,) that the gate's rule,
        e^2 <= c S, refuses under this prior too, and delta is the most probable change of the state that explains e.
        With H the slopes of the noiseless value t, H delta = e. So t's variance grows by n sum_i H_i^2 delta_i^2 /
        min(c, 1) >= e^2 / min(c, 1) (Cauchy and Schwarz), and then e^2 <= c S.
        """
        predicted, _ = self.base.predict_received(prior, k)
        noise, rule = at(self.base.noise, k), _get_gate_rule(self.base)
        # Innovation e, its variance S (`total`), and V = Var t, by the state alone (`of_state`).
        total = predicted.columns.diagonal + jnp.diagonal(jnp.asarray(noise.covariance))
        e = wrap_near(z, predicted.signal, self.base.received_angles) - predicted.signal - noise.center
        of_state = predicted.slopes**2 @ predicted.prior.variances
        needs_room = left_out & (e**2 > rule.c * total) & (of_state > 0)
        # delta of each number that would be refused, (n, m).
        change = _find_most_probable_change(predicted, jnp.where(needs_room, e, 0.0), of_state)
        # P + n diag(delta^2) / min(c, 1), summed over these numbers.
        n = len(self.states)
        wider = WeightedColumns(jnp.eye(n), n / jnp.minimum(rule.c, 1.0) * jnp.sum(change**2, axis=1))
        return from_columns(predicted.prior.mean, join_columns(predicted.prior.columns, wider))

    def _compare_densities(self, rival: Innovation, gate: Innovation, counts: jax.Array) -> jax.Array:
        """Return sum_i log p_rival(z_i) - log p_gate(z_i) over some numbers: evidence for the rival estimate.

        The gate leaves out numbers z_i far from its prediction; the rival is a second estimate that uses them too. The
        numbers which neither leaves out tell which of the two is right. Squared innovations over their variances are
        clipped at the gate's limit c (it accepts e^2 / S <= c), so that no outlier decides alone.

        Args:
            rival: innovation of z under the rival estimate.
            gate: innovation of the same z under the gate's estimate.
            counts: which numbers are compared (m,).
        """

        def log_density(innovation: Innovation) -> jax.Array:
            """Return -(min(e^2 / S, c) + log S) / 2 of each number (m,), with innovation e and variance S.

            It is 0 for numbers that are not compared, where `counts` (m,) is False.
            """
            variance = jnp.diagonal(jnp.asarray(innovation.covariance))
            variance = jnp.where(counts, variance, 1.0)
            squared = jnp.where(counts, jnp.asarray(innovation.value), 0.0) ** 2 / variance
            return -(jnp.minimum(squared, _get_gate_rule(self.base).c) + jnp.log(variance)) / 2

        return jnp.sum(log_density(rival) - log_density(gate))

    @estimates
    def estimate(self, state: GateAndRival) -> Estimate:
        """Return the mean and covariance of the gate's estimate (`believed`); the rival's is not reported."""
        return self.base.estimate(state.believed)

    def remark(self, state: GateAndRival) -> Remark:
        """Say how often the gate has adopted the rival estimate, when it last did, and how far each state moved then.

        These are `given_in`, `step` and `moved` (n,) of the filter's state.
        """
        count = int(state.given_in)
        if not count:
            return Remark()
        jumps = ", ".join(f"{name} by {jump:.3g}" for name, jump in zip(self.states, state.moved.tolist(), strict=True))
        how_often = "once" if count == 1 else f"{count} times"
        return Remark(count, f"the gate gave in {how_often}, last in row {int(state.step) + 1}, and moved {jumps}")


def _find_most_probable_change(predicted: PredictedMeasurement, e: jax.Array, of_state: jax.Array) -> jax.Array:
    """Return for each received number the most probable change of the state that explains its innovation, (n, m).

    t_i = E t_i + H_i (x - m) is number i without its noise, and e (m,) the innovations. Among the changes delta with
    H_i delta = e_i, a Gaussian x has the highest density at delta = E[x - m | t_i - E t_i = e_i] = Cov(x, t_i) e_i /
    V_i. `of_state` (m,) is V_i = Var t_i; if it is 0, t_i does not depend on the state, and the change is 0.
    """
    prior = predicted.prior
    # Cov(x, t) = L diag(d) slopes' of x = m + L xi and t = E t + slopes xi + noise.
    cross = prior.root @ (prior.variances[:, None] * predicted.slopes.T)
    return jnp.asarray(cross * (e / jnp.where(of_state > 0, of_state, 1.0)))


def _get_gate_rule(base: RobustFilter) -> Gate:
    """Return the rule of a filter that was built with a `Gate`: it accepts innovations with e^2 <= c S.

    `base.rule` may be any weighting rule by its type; only a gate is built into a `GivingInFilter`.
    """
    assert isinstance(base.rule, Gate)
    return base.rule


def _select_tree(condition: jax.Array, if_true: Any, if_false: Any) -> Any:
    """Return the tree of arrays `if_true` where the condition holds, else `if_false`."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)


def build_giving_in_filter(base: RobustFilter, rule: Gate) -> GivingInFilter:
    """Return a filter that recovers when its gate has locked out right measurements.

    A gate leaves out numbers far from its prediction; after a jump of the state it would leave out all. So a second
    estimate, which also uses them, runs beside it. After `rule.after` rejections in a row, or `rule.seconds` of them,
    the second estimate replaces the first. What the covariance is after that is approximate: the claim is "nominal".

    Args:
        base: the filter with the gate.
        rule: the gate, with its limits `after` and `seconds`.

    Raises:
        ValueError: seconds of a plant without the input dt.
    """
    if rule.seconds is not None and TIME_STEP not in base.inputs:
        raise fail("seconds of a gate", f"a plant with the input {TIME_STEP!r}, or after= refusals", list(base.inputs))
    sizes = make_sizes("nominal", base, base.received)  # claim, names of states and inputs, length of z
    return GivingInFilter(base=base, after=rule.after, seconds=rule.seconds, **sizes)
