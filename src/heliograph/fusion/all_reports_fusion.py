"""Fusion of all reports that have reached the centre: a Kalman filter of the state and of all nodes' errors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import (
    WeightedColumns,
    columns_of,
    eliminate,
    join_columns,
    noise_beside_repeated,
    rounding_of,
)
from heliograph.factors.factored_gaussian import (
    Gaussian,
    correct_by_gain,
    from_columns,
    gain_of,
    predict_affine,
    take_leading,
)
from heliograph.factors.pivots import square_root
from heliograph.filters.gaussian.signal_moments import augmented_second_moment
from heliograph.fusion.cross_covariance import ErrorMap, ErrorMoments
from heliograph.fusion.joint_covariance_fusion import AbstractInformedFusion, CentreStep
from heliograph.fusion.quantizer import widen_by_quantization
from heliograph.fusion.report_link import ReportModel
from heliograph.fusion.rules import Fused, Means
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.numerics.linalg import symmetric
from heliograph.numerics.types import Array, Bool, Float


class PastReports(NamedTuple):
    """Model of the reports that each node sent 0, 1, ... steps ago (the age), z = G (m + mu) + n.

    m is the node's estimate and mu the error of its quantizer. gain: E[G]. offset: E[n]. noise: the mean of Cov(z | m).
    error: bound of |mu|, zero without a quantizer.

    Shapes: gain (age, node, m, n), offset (age, node, m), noise (age, node, m, m), error (age, node, n).
    """

    gain: jax.Array
    offset: jax.Array
    noise: jax.Array
    error: jax.Array


class ReportsBelief(NamedTuple):
    """Estimate of the centre, of zeta = (x, e_1, ..., e_nodes, reports sent one step ago, two steps ago, ...).

    `gaussian` has N = (1 + nodes + nodes delays) n components. The error of its mean is u + v: Cov u is the covariance
    of `gaussian`, v comes from the quantizers, and v v' <= `quantizer_bound` (None without quantizers).
    """

    gaussian: Gaussian
    past: PastReports
    quantizer_bound: Float[jax.Array, "N N"] | None


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

    def start(self, errors: ErrorMoments) -> ReportsBelief:
        """Return the state before the first report, over lossless links."""
        return make_initial_belief(errors, 0, errors.bias.shape[1], quantized=False)

    def fuse_step(self, state: ReportsBelief, happened: CentreStep, means: Means) -> tuple[ReportsBelief, Fused]:
        """Return the next state, and the fused mean and covariance, after one step of the Kalman filter of all errors.

        `state`: estimate of the plant's state, of all nodes' errors and of past reports. `happened`: motion of the
        plant and recursion of the nodes' errors in this step. `means` (nodes, n): the estimates that the nodes sent,
        NaN for one that did not arrive.
        """
        nodes, n = means.shape
        predicted = propagate_errors(state, happened, make_lossless_links(nodes, n))
        # Measurements of the correction are the means. Links without delay deliver reports of age 0 alone.
        reports_by_age = jnp.asarray(means)[None]
        corrected, _ = correct_with_reports(predicted, reports_by_age)
        return corrected, estimate_state(corrected, n)


def make_lossless_links(nodes: int, n: int) -> ReportModel:
    """Return the model of links that deliver each node's estimate of n numbers unchanged and at once: z_i = m_i."""
    return ReportModel(
        gain=np.tile(np.eye(n), (nodes, 1, 1)),
        offset=np.zeros((nodes, n)),
        covariance=np.zeros((nodes, n, n, n + 1, n + 1)),
        error=np.zeros((nodes, n)),
    )


def make_initial_belief(errors: ErrorMoments, delays: int, received: int, quantized: bool) -> ReportsBelief:
    """Return the centre's belief of s = (x, e_1, ..., e_nodes, past reports) before the first report.

    A report is the estimate that a node sends to the centre, and may arrive some steps late. Filters start at known
    means m_i, so that each error e_i = x_0 - m_i deviates from its mean as x_0 does. With Cov x_0 = R diag(w) R' the
    covariance of s is [R; R; ...; R; 0] diag(w) [...]': kept as this root and w. Nothing has been sent: past reports,
    and the gains, offsets and noises of their model (`PastReports`), are zeros.

    Args:
        errors: mean and covariance of (x, e_1, ..., e_nodes) at the start.
        delays: largest delay of a report in steps, which is the number of past reports of each node in the state.
        received: numbers in each report that arrives.
        quantized: whether quantizers add errors, which a bound then follows; it starts at zero.
    """
    nodes, n = errors.bias.shape
    padding = (0, nodes * n * delays)  # zeros for past reports
    # The root of Cov s: R once for x and once for every e_i, then rows of zeros for the past reports.
    start = columns_of(errors.state_covariance)
    root_of_x_and_errors = jnp.tile(jnp.asarray(start.matrix), (1 + nodes, 1))
    root = jnp.pad(root_of_x_and_errors, (padding, (0, 0)))
    mean = jnp.pad(errors.mean.reshape(-1), padding)
    # Models of the reports sent 0, 1, ... `delays` steps ago: no gain, no noise.
    ages_and_nodes = (delays + 1, nodes)
    past = PastReports(
        gain=jnp.zeros((*ages_and_nodes, received, n)),
        offset=jnp.zeros((*ages_and_nodes, received)),
        noise=jnp.zeros((*ages_and_nodes, received, received)),
        error=jnp.zeros((*ages_and_nodes, n)),
    )
    quantizer_bound = jnp.zeros((len(mean), len(mean))) if quantized else None
    return ReportsBelief(from_columns(mean, WeightedColumns(root, start.weights)), past, quantizer_bound)


class ReportMap(NamedTuple):
    """Linear map of (zeta, reports sent one step ago, two steps ago, ...); `F @ columns` applies it.

    It moves zeta by its step, puts the reports x - e_i of the step before in front of the past ones, and drops the
    oldest.
    """

    transition: ErrorMap

    def __matmul__(self, columns: Float[Array, "N *columns"]) -> Float[jax.Array, "N *columns"]:
        """Return each column after a step: zeta moved by its transition, and past reports by one place.

        zeta = (x, errors e_i of the nodes). A report is x - e_i; past reports follow zeta, the latest first.
        """
        nodes, n, _ = self.transition.errors.shape
        zeta = columns[: (1 + nodes) * n]
        past_reports = columns[(1 + nodes) * n :]
        zeta_after = self.transition @ zeta
        if not len(past_reports):
            return zeta_after
        x, node_errors = zeta[:n], zeta[n:]
        newest_reports = jnp.concatenate([x] * nodes) - node_errors
        return jnp.concatenate([zeta_after, newest_reports, past_reports[: -nodes * n]])


def propagate_errors(state: ReportsBelief, centre_step: CentreStep, links: ReportModel) -> ReportsBelief:
    """Predict zeta = (x, e_1, ..., e_nodes) over a step, zeta+ = F zeta + f + B w - K nu; then each node sends x - e_i.

    A centre fuses reports of estimates m_i = x - e_i (e_i: the error of node i) by a Kalman filter of zeta, which has x
    and all errors as its state. F, f and B are the transition, offset and noise input of `centre_step`, which has the
    model of the step. w is the process noise, nu the noise of what the nodes receive, and K has their
    gains on its diagonal. `state` also holds past reports, since reports may come late. `links`: model of the reports
    that are sent at this step.
    """
    step, errors = centre_step
    nodes, n, _ = step.gain.shape
    state_size = len(state.gaussian.mean)  # of zeta and past reports
    zeta_size = len(step.offset)
    # Noise of zeta. B w is common to x and all errors. K nu reaches the errors alone: `behind_x` puts it behind x. A
    # third part covers rounding errors, in proportion to E[x x'].
    behind_x = np.eye(zeta_size, nodes * n, -n)
    zeta_noise = join_columns(
        columns_of(step.process).through(step.noise_input),
        _factor_measurement_noise(step.gain, step.received).through(behind_x),
        rounding_of(jnp.tile(_find_second_moments_of_state(errors), 1 + nodes)),
    )
    # The whole state: zeta moves by F, past reports become one step older, without offset or noise.
    report_map = ReportMap(step.transition)
    offset = jnp.pad(step.offset, (0, state_size - zeta_size))
    noise = zeta_noise.through(np.eye(state_size, zeta_size))
    predicted = predict_affine(state.gaussian, report_map, offset, noise)
    # The bound Q of the errors by quantizers moves without noise, F Q F'.
    quantizer_bound = None
    if state.quantizer_bound is not None:
        quantizer_bound = symmetric(propagate_by_mode(report_map, state.quantizer_bound, 0.0))
    return ReportsBelief(predicted, _prepend_present_reports(state.past, errors, links), quantizer_bound)


def _find_second_moments_of_state(errors: ErrorMoments) -> Float[jax.Array, " n"]:
    """Return E[x_i^2] of each component of the plant's state, before any data (n,)."""
    return jnp.asarray(errors.state_mean**2 + jnp.diagonal(errors.state_covariance))


class PredictedReports(NamedTuple):
    """Predicted mean of the reports, (age, node, m) flattened, and their innovation covariance."""

    mean: Float[jax.Array, " M"]
    covariance: Float[jax.Array, "M M"]


def correct_with_reports(
    state: ReportsBelief, reports: Float[jax.Array, "age node m"]
) -> tuple[ReportsBelief, PredictedReports]:
    """Correct with the reports z = C s + c + n that arrived, by their age in steps; NaN for those that did not arrive.

    s is the centre's state, which holds the plant's state and every node's error, and n the noise of the reports.
    Quantizers (rounding to codewords) add G mu to the reports, with the links' gains G and |mu| <= `past.error`.

    Args:
        state: the law of s, gains, offsets c and noises of the reports by age (`past`), and a bound of the covariance
            of the error that quantizers cause.
        reports: NaN where none arrived.

    Returns:
        The corrected state, and the mean and covariance of the reports before they arrived.
    """
    # C, the expected reports C s + c, and the filter's gain K, in which rows that did not arrive count nothing.
    x = state.gaussian
    past = state.past
    values = jnp.ravel(reports)
    output = _make_output_matrix(past, len(x.mean))
    expected = output @ x.mean + jnp.ravel(past.offset)
    is_present = ~jnp.isnan(values)
    noise = _factor_each(past.noise)
    gain = _compute_gain(x, output, past, is_present)
    # Innovation z - (C s + c), and the error after the correction without quantizers, (I - K C) e - K n.
    innovation = jnp.where(is_present, values - expected, 0.0)
    slopes = jnp.asarray(output @ x.root)
    corrected = correct_by_gain(x, slopes, noise, gain, innovation)
    quantizer_bound = None
    if state.quantizer_bound is not None:
        quantizer_bound = _correct_quantizer_bound(state.quantizer_bound, gain, output, past)
    report_law = PredictedReports(expected, join_columns(WeightedColumns(slopes, x.variances), noise).covariance)
    return ReportsBelief(corrected, past, quantizer_bound), report_law


def _correct_quantizer_bound(
    bound: Float[jax.Array, "N N"], gain: Float[jax.Array, "N M"], output: Float[jax.Array, "M N"], past: PastReports
) -> Float[jax.Array, "N N"]:
    """Return a matrix above v+ v+' after a correction, from `bound`, one above v v' before it.

    v is the part of the centre's error that quantizers cause: v+ = (I - K C) v - K G mu, with the gain K, the `output`
    matrix C, the links' gains G and the quantizers' errors |mu| <= `past.error`. The first term is bounded as a linear
    map does, the second by Cauchy's inequality, and the sum by Young's.
    """
    remaining = propagate_by_mode(jnp.eye(len(bound)) - gain @ output, bound, 0.0)
    added = _bound_by_cauchy(gain @ _place_on_diagonal(past.gain), jnp.ravel(past.error))
    return symmetric(_bound_by_young(remaining, added))


def _compute_gain(
    x: Gaussian, output: Float[jax.Array, "M N"], past: PastReports, present: Bool[jax.Array, " M"]
) -> Float[jax.Array, "N M"]:
    """Return the gain for what arrived, with the errors of quantizers and rounding as noise of each report.

    x: state of the centre. `output`: matrix from x to the reports. `past`: gain, offset, noise and quantizers' error of
    reports by age and node. `present`: which numbers arrived.
    """
    identity = np.eye(past.noise.shape[-1])
    shape = past.offset.shape
    # A report that earlier ones determine is measured again, with slopes that are rounding errors. A noise of the size
    # of these errors keeps the gain from dividing them by themselves.
    sizes_of_terms = jnp.reshape(jnp.abs(output) @ square_root(x.columns.diagonal), shape)
    # The error of a quantizer is taken as uniform within +-error, with the variance error^2 / 3.
    quantizer_noise = (past.gain * (past.error**2 / 3)[..., None, :]) @ past.gain.swapaxes(-1, -2)
    noise = past.noise + quantizer_noise + identity * noise_beside_repeated(sizes_of_terms)[..., None]
    # Numbers that did not arrive get slopes of zero and independent noise of variance 1.
    arrived = present.reshape(shape)
    noise = jnp.where(arrived[..., :, None] & arrived[..., None, :], noise, identity)
    slopes = jnp.where(present[:, None], output @ x.root, 0.0)
    return jnp.where(present, gain_of(x, slopes, _factor_each(noise)), 0.0)


def estimate_state(state: ReportsBelief, n: int) -> Fused:
    """Return the estimate of x, the first n numbers of the centre's state, with the covariance of its error.

    With quantizers it is a bound: the error is u + v, Cov u in `state.gaussian`, v v' <= `state.quantizer_bound`, and
    the bound on E[(u + v)(u + v)'] holds whatever the correlation of u and v.
    """
    x = take_leading(state.gaussian, n)
    mean = jnp.asarray(x.mean)
    covariance = jnp.asarray(x.covariance)
    if state.quantizer_bound is None:
        return mean, covariance
    return mean, _bound_by_young(covariance, state.quantizer_bound[:n, :n])


def _prepend_present_reports(past: PastReports, errors: ErrorMoments, links: ReportModel) -> PastReports:
    """Put the model of the reports that are sent now before those of earlier steps, and drop the oldest.

    The noise of a report, Cov(z_i | m_i) of z_i = G_i m_i + n_i, is the covariance of the link's random gains
    (`links.covariance`) applied to E[(m_i, 1)(m_i, 1)'], the second moment of what node i sends, before any data.
    """
    mean = errors.state_mean - errors.bias  # E m_i of each node's estimate m_i = x - e_i
    # E m_i m_i' = Cov x - Cov(e_i, x) - Cov(x, e_i) + Cov e_i + E m_i E m_i'.
    error_covariances = jnp.einsum("iaib->iab", errors.joint)
    cross = errors.with_state + jnp.swapaxes(errors.with_state, 1, 2)
    second = errors.state_covariance - cross + error_covariances + mean[:, :, None] * mean[:, None]
    # Second moments of (m_i, 1), with the quantizers' error.
    error = jnp.asarray(links.error)
    sent = jax.vmap(lambda s, m: augmented_second_moment(s, m, 1.0))(second, mean)
    sent = jax.vmap(widen_by_quantization)(sent, jnp.pad(error, ((0, 0), (0, 1))))
    # A link whose gains are not random adds no noise, also where the moments of what is sent are unknown (NaN), as they
    # are along the estimates of one run.
    has_random_gains = jnp.any(jnp.asarray(links.covariance) != 0, axis=(1, 2, 3, 4))
    noise = jnp.einsum("iabcd,icd->iab", links.covariance, jnp.where(has_random_gains[:, None, None], sent, 0.0))
    present = PastReports(gain=jnp.asarray(links.gain), offset=jnp.asarray(links.offset), noise=noise, error=error)
    return PastReports(*(jnp.concatenate([new[None], old[:-1]]) for new, old in zip(present, past, strict=True)))


def _make_output_matrix(past: PastReports, length: int) -> Float[jax.Array, "M N"]:
    """Return C of E[reports | s] = C s + offset, the matrix of the centre's measurements (ages nodes m, length).

    s has `length` numbers: x (n), the errors e_1, ..., e_nodes (nodes n), then what all nodes sent 1, 2, ... steps
    before (nodes n for each age). Node i sends its estimate x - e_i. Its report of age a is G_ai times what it sent a
    steps ago: x - e_i for a = 0, an entry of s for a > 0. Rows of C: age after age, node after node.
    """
    ages, nodes, m, n = past.gain.shape
    size = nodes * n  # of all errors together, and of what is sent at one step
    # What was sent, as linear functions of s. At this step [I; ...; I] x - (e_1, ..., e_nodes):
    sent_now = np.concatenate([np.tile(np.eye(n), (nodes, 1)), -np.eye(size)], axis=1)
    sent_now = np.pad(sent_now, ((0, 0), (0, length - n - size)))
    # At earlier steps: the entries of s behind x and the errors.
    sent_before = np.eye(length - n - size, length, n + size)
    sent = np.concatenate([sent_now, sent_before]).reshape(ages, nodes, n, length)
    return jnp.einsum("aimn,ainN->aimN", past.gain, sent).reshape(ages * nodes * m, length)


def _factor_measurement_noise(gain: Float[jax.Array, "node n m"], noise: Array) -> WeightedColumns:
    """Return factors of the matrix with blocks K_i S_ij K_j', with one column for each measurement.

    K_i is the gain of node i, and S_ij the covariance of what nodes i and j receive. `noise` is (node, m, m) if nodes
    share nothing, so that S_ij = 0 for i != j, and otherwise (node, m, node, m).
    """
    nodes, _, m = gain.shape
    if noise.ndim == 3:
        received = _factor_each(jnp.asarray(noise)[None])
    else:
        received = columns_of(noise.reshape(nodes * m, nodes * m))
    return received.through(_place_on_diagonal(gain[None]))


def _factor_each(noise: Float[jax.Array, "age node m m"]) -> WeightedColumns:
    """Return factors L diag(d) L' of the joint covariance of the noises of all reports, which are independent.

    `noise` has the covariance (m, m) of each report. Their joint one is block-diagonal, age after age and node after
    node, and so is L.
    """
    ages, nodes, m, _ = noise.shape
    blocks = jax.vmap(eliminate)(noise.reshape(ages * nodes, m, m))
    return WeightedColumns(_place_on_diagonal(blocks.matrix.reshape(noise.shape)), jnp.ravel(blocks.weights))


def _place_on_diagonal(blocks: Float[jax.Array, "age node a b"]) -> Float[jax.Array, "M S"]:
    """Return the block-diagonal matrix of these blocks (a, b), one for each age and node."""
    ages, nodes, rows, columns = blocks.shape
    count = ages * nodes
    numbers = jnp.arange(count)
    zeros = jnp.zeros((count, rows, count, columns))
    block_diagonal = zeros.at[numbers, :, numbers, :].set(blocks.reshape(-1, rows, columns))
    return block_diagonal.reshape(count * rows, count * columns)


def _bound_by_cauchy(matrix: Float[jax.Array, "N S"], largest: Float[jax.Array, " S"]) -> Float[jax.Array, "N N"]:
    """Return s B diag(D) B' with s = sum D, which bounds (B mu)(B mu)' for every mu with |mu| <= D (Cauchy).

    B is `matrix`, and D the `largest` size of each component of mu. Components whose column of B is zero do not count.
    """
    used = jnp.where(jnp.any(matrix != 0, axis=0), largest, 0.0)
    return jnp.sum(used) * (matrix * used) @ matrix.T


def _bound_by_young(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return (1 + s / r) A + (1 + r / s) B >= E[(u + v)(u + v)'], the bound of least trace by Young's inequality.

    r^2 = tr A and s^2 = tr B. A and B bound E[u u'] and E[v v'], and the correlation of u and v may be any. If r or s
    is 0, the bound is A + B.
    """
    r, s = jnp.sqrt(jnp.trace(a)), jnp.sqrt(jnp.trace(b))
    are_positive = (r > 0) & (s > 0)
    ratio = jnp.where(are_positive, s / jnp.where(r > 0, r, 1.0), 1.0)
    return jnp.where(are_positive, (1 + ratio) * a + (1 + 1 / ratio) * b, a + b)
