"""Best linear estimate from all reports that reached the fusion centre so far, with the nodes' errors as states."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.signal import homogeneous
from heliograph.fusion.cross_covariance import Errors, observation_noise
from heliograph.fusion.informed import AbstractInformedFusion, Happened
from heliograph.fusion.quantizer import widen
from heliograph.fusion.report_link import ReportModel
from heliograph.fusion.rules import Fused, Means
from heliograph.fusion.weights import RANK
from heliograph.numerics.lapack import pseudo_solve
from heliograph.numerics.linalg import rounding, symmetric
from heliograph.numerics.types import Float


class Past(NamedTuple):
    """Reports sent 0, 1, ... steps ago: mean gain, offset, mean noise Cov(z | sent), and the quantizers' error.

    Shapes: gain (age, node, m, n), offset (age, node, m), noise (age, node, m, m), error (age, node, n).
    """

    gain: jax.Array
    offset: jax.Array
    noise: jax.Array
    error: jax.Array


class ReportsBelief(NamedTuple):
    """Estimate of the centre, of zeta = (x, e_1, ..., e_nodes, reports sent one step ago, two steps ago, ...).

    mean (N,) and covariance (N, N), N = (1 + nodes + nodes delays) n; `spill` bounds the square of the part of the
    error that comes from quantizers: the error of the mean is one of this covariance plus one within that bound.
    """

    mean: Float[jax.Array, " N"]
    covariance: Float[jax.Array, "N N"]
    past: Past
    spill: Float[jax.Array, "N N"] | None


class AllReports(AbstractInformedFusion):
    """A Kalman filter of the plant and of every node's error, whose measurements are the reports x - e_i, with memory.

    Where every report arrives it equals the central filter if every gain has full column rank: the centre could
    recompute each measurement. It uses more information than weights of the present estimates, at the price of a state
    of all errors.

    Reports that fade, get lost or are late (`ReportLink`), or are quantized, are modelled as such; a late report is one
    of the past estimate, which is a state for as long as it may arrive.

    Claim: as `MatrixWeights`; behind quantizers what these leave of it. Refused where the
    centre cannot know the nodes' gains: nodes that lose measurements behind links that may lack their report.

    Source: the best linear receiver behind relays that filter and forward; the relays are the nodes' filters.
    """

    @property
    def uses_reports(self) -> bool:
        """True: it uses reports that fade, are late, or never arrive."""
        return True

    def start(self, errors: Errors) -> ReportsBelief:
        """Return the state before the first report, over lossless links."""
        return begin(errors, 0, errors.bias.shape[1], quantized=False)

    def use(self, state: ReportsBelief, happened: Happened, means: Means) -> tuple[ReportsBelief, Fused]:
        """Move the plant and all errors, then use the reports; one that is NaN did not arrive."""
        nodes, n = means.shape
        after, _ = receive_reports(propagate_errors(state, happened, faithful(nodes, n)), jnp.asarray(means)[None])
        return after, estimate_state(after, n)


def faithful(nodes: int, n: int) -> ReportModel:
    """Lossless links, which deliver what is sent."""
    zero = np.zeros((nodes, n))
    return ReportModel(np.tile(np.eye(n), (nodes, 1, 1)), zero, np.zeros((nodes, n, n, n + 1, n + 1)), zero)


def begin(errors: Errors, delays: int, received: int, quantized: bool) -> ReportsBelief:
    """Return the state before the first report, for so many `delays` and `received` numbers per report."""
    nodes, n = errors.bias.shape
    size = nodes * n
    cross, joint = errors.with_state.reshape(size, n), errors.joint.reshape(size, size)
    later = (0, size * delays)
    covariance = jnp.pad(jnp.block([[errors.covariance, cross.T], [cross, joint]]), (later, later))
    mean = jnp.pad(jnp.concatenate([errors.mean, errors.bias.reshape(-1)]), later)
    shapes = (received, n), (received,), (received, received), (n,)
    past = Past(*(jnp.zeros((delays + 1, nodes, *shape)) for shape in shapes))
    return ReportsBelief(mean, covariance, past, jnp.zeros_like(covariance) if quantized else None)


def propagate_errors(state: ReportsBelief, happened: Happened, links: ReportModel) -> ReportsBelief:
    """Predict x- = A x + b + w and e+ = T e + G x + g + B w - K nu together; then each node sends x- - e+."""
    motion, step, noise, _ = happened
    nodes, n, _ = step.transition.shape
    size = nodes * n
    # Transition of (x, e_1, ...): A on top, G and T below.
    items = jnp.arange(nodes)
    errors = jnp.zeros((nodes, n, nodes, n)).at[items, :, items, :].set(step.transition).reshape(size, size)
    plant = jnp.pad(jnp.asarray(motion.matrix), ((0, 0), (0, size)))
    transition = jnp.concatenate([plant, jnp.concatenate([step.of_state.reshape(size, n), errors], axis=1)])
    # Noise: w is common to all, nu enters by each node's gain.
    shared = jnp.concatenate([jnp.eye(n), step.of_noise.reshape(size, n)])
    report_noise = jnp.pad(observation_noise(step.gain, noise).reshape(size, size), ((n, 0), (n, 0)))
    drift = jnp.concatenate([jnp.asarray(motion.shift), step.drift.reshape(-1)])
    new = shared @ motion.noise @ shared.T + report_noise
    later = len(state.mean) - n - size
    # The line of past reports shifts by one step.
    if later:
        stored = _make_shift_matrix(nodes, n, later)
        transition = jnp.concatenate([jnp.pad(transition, ((0, 0), (0, later))), stored])
        new, drift = jnp.pad(new, (0, later)), jnp.pad(drift, (0, later))
    return ReportsBelief(
        transition @ state.mean + drift,
        symmetric(transition @ state.covariance @ transition.T + new),
        _prepend_present(state.past, happened, links),
        None if state.spill is None else symmetric(transition @ state.spill @ transition.T),
    )


class Expected(NamedTuple):
    """Predicted mean of the reports, (age, node, m) flattened, and their innovation covariance."""

    mean: Float[jax.Array, " M"]
    covariance: Float[jax.Array, "M M"]


def receive_reports(state: ReportsBelief, reports: Float[jax.Array, "age node m"]) -> tuple[ReportsBelief, Expected]:
    """Correct with the reports that arrived, by their age in steps; NaN for those that did not arrive now.

    With zeta- = F zeta and errors mu of quantizers, |mu| <= D, the gain K is that for mu white and even, D^2 / 3; the
    error then is (I - K O) e - K n, whose covariance is carried along, and -K mu, within `spill`.
    """
    # Innovation, zero for reports that did not arrive.
    values = jnp.ravel(reports)
    output, offset = _output(state.past, len(state.mean)), jnp.ravel(state.past.offset)
    noise = _along_diagonal(state.past.noise)
    present = ~jnp.isnan(values)
    expected = output @ state.mean + offset
    unexpected = jnp.where(present, values - expected, 0.0)
    # S = O P O' + N, with quantizers' errors as white noise of variance D^2 / 3.
    total = symmetric(output @ state.covariance @ output.T + noise)
    cross = jnp.where(present[:, None], output @ state.covariance, 0.0)
    push = _make_quantizer_matrix(state.past, present)
    wide = push @ (jnp.ravel(state.past.error)[:, None] ** 2 / 3 * push.T)
    gain = pseudo_solve(_mask_absent(present, total + wide), cross, rounding(0.0, total, RANK)).T
    # Joseph's form, sums of squares; the errors mu themselves enter the bound (Young, Cauchy).
    keep = jnp.eye(len(state.mean)) - gain @ output
    covariance = symmetric(keep @ state.covariance @ keep.T + gain @ _mask_absent(present, noise) @ gain.T)
    spill = None
    if state.spill is not None:
        spill = symmetric(_sum(keep @ state.spill @ keep.T, _within(gain @ push, jnp.ravel(state.past.error))))
    return ReportsBelief(state.mean + gain @ unexpected, covariance, state.past, spill), Expected(expected, total)


def estimate_state(state: ReportsBelief, n: int) -> Fused:
    """Estimate of x, with the covariance of its error or a bound on it."""
    covariance = state.covariance[:n, :n]
    return state.mean[:n], covariance if state.spill is None else _sum(covariance, state.spill[:n, :n])


def _prepend_present(past: Past, happened: Happened, links: ReportModel) -> Past:
    """Put the present reports before those of earlier steps."""
    errors = happened.errors
    mean = errors.mean - errors.bias
    blocks = jnp.einsum("iaib->iab", errors.joint)
    # E m m' of each node's estimate m = x - e, by the covariances of x and e and of both.
    both = errors.with_state + jnp.swapaxes(errors.with_state, 1, 2)
    second = errors.covariance - both + blocks + mean[:, :, None] * mean[:, None]
    # Noise of the reports: the spread of the links on what is sent, and the quantizers' error.
    error = jnp.asarray(links.error)
    known = jax.vmap(lambda s, m: homogeneous(s, m, 1.0))(second, mean)
    known = jax.vmap(widen)(known, jnp.pad(error, ((0, 0), (0, 1))))
    noise = jnp.einsum("iabcd,icd->iab", links.spread, known)
    new = Past(jnp.asarray(links.gain), jnp.asarray(links.offset), noise, error)
    return Past(*(jnp.concatenate([a[None], b[:-1]]) for a, b in zip(new, past, strict=True)))


def _make_shift_matrix(nodes: int, n: int, later: int) -> Float[np.ndarray, "later N"]:
    """Shift matrix of the line: x - e_i becomes the report of one step ago, and so on."""
    size = nodes * n
    sent = np.concatenate([np.tile(np.eye(n), (nodes, 1)), -np.eye(size), np.zeros((size, later))], axis=1)
    shift = np.eye(later - size, n + size + later, n + size)
    return np.concatenate([sent, shift])


def _output(past: Past, length: int) -> Float[jax.Array, "M N"]:
    """Output matrix of the reports: mean gains on x - e_i now, and on the reports of earlier steps."""
    ages, nodes, m, n = past.gain.shape
    size = nodes * n
    now = np.concatenate([np.tile(np.eye(n), (nodes, 1)), -np.eye(size)], axis=1)
    before = np.eye(length - n - size, length, n + size)
    sent = np.concatenate([np.pad(now, ((0, 0), (0, length - n - size))), before]).reshape(ages, nodes, n, length)
    return jnp.einsum("aimn,ainN->aimN", past.gain, sent).reshape(ages * nodes * m, length)


def _mask_absent(present: jax.Array, matrix: jax.Array) -> jax.Array:
    return jnp.where(present[:, None] & present, matrix, 0.0)


def _make_quantizer_matrix(past: Past, present: jax.Array) -> Float[jax.Array, "M S"]:
    """Matrix by which the quantizers' errors, (age, node, n) flattened, enter the reports that arrived."""
    return jnp.where(present[:, None], _along_diagonal(past.gain), 0.0)


def _along_diagonal(blocks: Float[jax.Array, "age node a b"]) -> Float[jax.Array, "M S"]:
    """Block-diagonal matrix of these blocks."""
    ages, nodes, rows, columns = blocks.shape
    items = jnp.arange(ages * nodes)
    empty = jnp.zeros((len(items), rows, len(items), columns))
    full = empty.at[items, :, items, :].set(blocks.reshape(-1, rows, columns))
    return full.reshape(len(items) * rows, len(items) * columns)


def _within(into: Float[jax.Array, "N S"], error: Float[jax.Array, " S"]) -> Float[jax.Array, "N N"]:
    """B with (B mu)(B mu)' <= B s diag(D) B' for |mu| <= D, s = sum D over what B uses (Cauchy)."""
    used = jnp.where(jnp.any(into != 0, axis=0), error, 0.0)
    return jnp.sum(used) * (into * used) @ into.T


def _sum(a: jax.Array, b: jax.Array) -> jax.Array:
    """(1 + s / r) A + (1 + r / s) B, a bound on E[(u + v)(u + v)'] of least trace: r^2 = tr A, s^2 = tr B (Young)."""
    r, s = jnp.sqrt(jnp.trace(a)), jnp.sqrt(jnp.trace(b))
    both = (r > 0) & (s > 0)
    ratio = jnp.where(both, s / jnp.where(r > 0, r, 1.0), 1.0)
    return jnp.where(both, (1 + ratio) * a + (1 + 1 / ratio) * b, a + b)
