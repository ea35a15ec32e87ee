"""The best linear estimate from every report that ever reached the fusion centre: filters at nodes are relays too."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.fusion.cross_covariance import Errors, heard_noise
from heliograph.fusion.informed import AbstractInformedFusion, Happened
from heliograph.fusion.rules import Fused, Means
from heliograph.fusion.weights import solve_known
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.small_matrix import with_rounding
from heliograph.numerics.types import Float


class Knowledge(NamedTuple):
    """What the centre knows of (x, e_1, ..., e_nodes): mean (N,) and covariance (N, N), N = (1 + nodes) n."""

    mean: Float[jax.Array, " N"]
    covariance: Float[jax.Array, "N N"]


class AllReports(AbstractInformedFusion):
    """A Kalman filter of the plant and of every node's error, which hears the reports x - e_i, in memory of all before.

    Where every report arrives it equals the central filter if every gain has full column rank: the centre could compute
    each measurement back. It knows more than any weights of what is said now, at the price of a state of all errors.

    Claim: as `MatrixWeights`.

    Source: the best linear receiver behind relays that filter and forward; the relays are the nodes' filters.
    """

    def start(self, errors: Errors) -> Knowledge:
        """Before the first report."""
        nodes, n = errors.bias.shape
        own = errors.own.reshape(nodes * n, n)
        joint = errors.joint.reshape(nodes * n, nodes * n)
        covariance = jnp.block([[errors.covariance, own.T], [own, joint]])
        return Knowledge(jnp.concatenate([errors.mean, errors.bias.reshape(-1)]), covariance)

    def use(self, state: Knowledge, happened: Happened, means: Means) -> tuple[Knowledge, Fused]:
        """Move the plant and all errors, then hear the reports; one that is NaN did not arrive."""
        before, reports = _moved(state, happened), jnp.ravel(means)
        nodes, n = means.shape
        output = jnp.concatenate([jnp.tile(jnp.eye(n), (nodes, 1)), -jnp.eye(nodes * n)], axis=1)
        present = ~jnp.isnan(reports)
        cross = jnp.where(present[:, None], output @ before.covariance, 0.0)
        gain = solve_known(jnp.where(present, cross @ output.T, 0.0), cross).T
        mean = before.mean + gain @ jnp.where(present, reports - output @ before.mean, 0.0)
        covariance = symmetrize(with_rounding(before.covariance, nodes * n) - gain @ cross)
        return Knowledge(mean, covariance), (mean[:n], covariance[:n, :n])


def _moved(state: Knowledge, happened: Happened) -> Knowledge:
    """x- = A x + b + w and e+ = T e + G x + g + B w - K nu, together."""
    motion, step, noise, _ = happened
    nodes, n, _ = step.transition.shape
    size = nodes * n
    each = jnp.arange(nodes)
    errors = jnp.zeros((nodes, n, nodes, n)).at[each, :, each, :].set(step.transition).reshape(size, size)
    plant = jnp.pad(jnp.asarray(motion.matrix), ((0, 0), (0, size)))
    transition = jnp.concatenate([plant, jnp.concatenate([step.of_state.reshape(size, n), errors], axis=1)])
    shared = jnp.concatenate([jnp.eye(n), step.of_noise.reshape(size, n)])
    own = jnp.pad(heard_noise(step.gain, noise).reshape(size, size), ((n, 0), (n, 0)))
    drift = jnp.concatenate([jnp.asarray(motion.shift), step.drift.reshape(-1)])
    covariance = transition @ state.covariance @ transition.T + shared @ motion.noise @ shared.T + own
    return Knowledge(transition @ state.mean + drift, symmetrize(covariance))
