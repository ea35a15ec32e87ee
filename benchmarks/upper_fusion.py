"""Search for a claim of "upper" that is broken, where estimates are fused, sent as whole numbers, or smoothed.

Run: python benchmarks/upper_fusion.py [ASCENTS]. As upper_claims.py, by ascent over what is unknown: of a rule the
joint covariance of the errors, of which only each estimate's own is bounded; of a quantizer how its error depends on
that of the estimate; between neighbours the network and what arrives; of smoothed estimates the noise within bounds.
The true error is exact. Prints the largest ratio of true to claimed squared error over all directions.
"""

import sys
import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from upper_claims import HORIZON, ROUNDING, SEED, STEPS, N, Numbers, Ratio, Reader, ascended, largest, plant_of

import heliograph as hg
from heliograph.fusion.quantizer import widen_by_quantization

COUNT, ROWS = 3, 6  # estimates that are fused; rows that are smoothed
NODES = ("a", "b", "c")


def joint_covariance(read: Reader, size: int) -> np.ndarray:
    """A covariance (size, size) with correlations up to 1: a product of few columns, and a little of all others."""
    root = read.real(size, size) * np.exp(2 * read.real(size))
    joint: np.ndarray = root @ root.T + 1e-6 * np.trace(root @ root.T) * np.eye(size)
    return joint


def blocks(joint: np.ndarray) -> np.ndarray:
    """Covariances of the parts (COUNT, N, N) of a joint one."""
    parts = joint.reshape(COUNT, N, COUNT, N)
    return parts[np.arange(COUNT), :, np.arange(COUNT), :]


def fused(rule: Any, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (N, COUNT N) of a rule, which is linear in the means, and the covariance that it claims."""
    batch = np.eye(COUNT * N).reshape(COUNT * N, COUNT, N)
    claimed = np.broadcast_to(covariances, (len(batch), *covariances.shape))
    result = hg.fusion.fuse(rule, [hg.model.Estimate(batch[:, i], claimed[:, i], "upper") for i in range(COUNT)])
    assert result.claim == "upper", result.claim
    return np.asarray(result.mean).T, np.asarray(result.covariance)[0]


def intersected(rule: Callable[[Reader], Any]) -> Callable[[Numbers], Ratio]:
    """Make the ratio of a rule that knows of each error no more than a bound."""

    def ratio(numbers: Numbers) -> Ratio:
        read = Reader(numbers.free)
        joint = joint_covariance(read, COUNT * N)
        above = np.array([read.covariance(1e-6, 1.0) for _ in range(COUNT)])
        weights, claimed = fused(rule(read), blocks(joint) + above * read.positive(1e-9, 1.0))
        return both(weights @ joint @ weights.T, claimed)

    return ratio


def split(independent: bool) -> Callable[[Numbers], Ratio]:
    """Make the ratio of split intersection: a part is jointly known, of the other each covariance is bounded."""

    def ratio(numbers: Numbers) -> Ratio:
        read = Reader(numbers.free)
        known, unknown = joint_covariance(read, COUNT * N), joint_covariance(read, COUNT * N)
        if independent:
            known *= np.kron(np.eye(COUNT), np.ones((N, N)))
        given = blocks(known) if independent else known.reshape(COUNT, N, COUNT, N)
        weights, claimed = fused(hg.fusion.SplitIntersection(given), blocks(known + unknown))
        return both(weights @ (known + unknown) @ weights.T, claimed)

    return ratio


def quantized(numbers: Numbers) -> Ratio:
    """Ratio of a covariance that is widened: e takes four values, and what is added any within its bounds for each."""
    read = Reader(numbers.free)
    values, chance = read.real(4, N) * np.exp(2 * read.real(4, 1)), read.probabilities(4)
    most = np.exp(read.real(N))
    sent = values + most * np.tanh(3 * read.real(4, N))
    with jax.enable_x64(True):
        claimed = np.asarray(widen_by_quantization((chance * values.T) @ values, most))
    return both((chance * sent.T) @ sent, claimed)


def neighbours(rule: Any) -> Callable[[Numbers], Ratio]:
    """Make the ratio of a rule between neighbours, after whatever messages arrived."""

    def ratio(numbers: Numbers) -> Ratio:
        read = Reader(numbers.free)
        plant, link = plant_of(read), hg.hop(hg.random_affine.Rician(0.8, 0.3), read.positive(1e-3, 1.0))
        nodes = {}
        for name in NODES:
            sensor = hg.LinearSensor(read.real(1, N), read.positive(1e-3, 1.0))
            nodes[name] = hg.Node(sensor, link, {"alone": hg.linear_filter(plant, sensor, link)})
        near = {name: [other for other in NODES if other != name] for name in NODES}
        lossy = hg.erasure(hg.perfect(), 0.5)
        network = hg.Network(plant, nodes, {"mesh": hg.Fusion("alone", rule, neighbours=near, link=lossy)})
        assert {claims["mesh"] for claims in network.claims().values()} == {"upper"}
        arrived = hg.simulation.mesh_arrivals(network, "mesh", HORIZON, int(numbers.corners[0]))
        found = hg.simulation.mesh_errors(network, "mesh", arrived)
        pairs = zip(found.actual.reshape(-1, N, N), found.claimed.reshape(-1, N, N), strict=True)
        most = max(largest(true, claimed) for true, claimed in pairs)
        return Ratio(most, most)

    return ratio


def smoothed(numbers: Numbers) -> Ratio:
    """Ratio of smoothed estimates, linear in z = C x + v, where the variance of v at each row is known by a bound."""
    read = Reader(numbers.free)
    plant, matrix, law, sizes = bounded_noise(read)
    filter = hg.kalman_filter(plant, hg.LinearSensor(matrix, law))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rows of a unit matrix are no likely data
        results = [hg.rts_smoother(filter, row) for row in (np.zeros(ROWS), *np.eye(ROWS))]
    return responded(plant, np.tile(matrix, (ROWS, 1, 1)), sizes, results)


def mode_known(numbers: Numbers) -> Ratio:
    """Ratio of a filter to which a link's modes are told, given them: z = g (C x + v) + n with v known by a bound."""
    read = Reader(numbers.free)
    plant, matrix, law, sizes = bounded_noise(read)
    gains, noises = 0.8 + 0.7 * read.real(2), np.array([read.positive(1e-2, 1.0) for _ in range(2)])
    hops = [hg.hop(float(g), float(n)) for g, n in zip(gains, noises, strict=True)]
    chain = hg.random_affine.MarkovChain(np.array([read.probabilities(2) for _ in range(2)]))
    filter = hg.filters.mode_known_filter(plant, hg.LinearSensor(matrix, law), hg.markov_fading(hops, chain))
    modes = numbers.corners[:ROWS] % 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results = [filter.run(np.stack([row, modes], axis=1)) for row in (np.zeros(ROWS), *np.eye(ROWS))]
    g = gains[modes]
    return responded(plant, g[:, None, None] * matrix, g**2 * sizes + noises[modes], results)


def bounded_noise(read: Reader) -> tuple[Any, np.ndarray, Any, np.ndarray]:
    """A plant, a sensor's matrix, its noise known by a bound, and variances within the bound, one for each row."""
    r, share, grown = read.positive(1e-3, 1.0), read.positive(0.01, 0.5), read.positive(1.0, 100.0)
    plant, matrix = plant_of(read), read.real(1, N)
    sizes = r * (1 + np.tanh(np.abs(read.real(ROWS))) * share * (grown - 1))
    return plant, matrix, hg.Contaminated.at_most(r, share, grown * r), sizes


def responded(plant: Any, matrices: np.ndarray, sizes: np.ndarray, results: list[Any]) -> Ratio:
    """Ratio of estimates that are linear in z_k = C_k x_k + v_k, from those of no and of unit measurements."""
    result, *columns = results
    assert result.claim == "upper", result.claim
    gains = np.stack([column.means - result.means for column in columns], axis=-1).reshape(ROWS * N, ROWS)
    # States as sums of the initial error and each step's noise, and the size of v at each row within its bounds.
    motion, states, noise = (
        np.asarray(plant.matrix),
        np.asarray(plant.initial_covariance),
        np.asarray(plant.noise.covariance),
    )
    joint = np.zeros((ROWS, N, ROWS, N))
    for k in range(ROWS):
        states = motion @ states @ motion.T + noise
        ahead = states
        for j in range(k, ROWS):
            joint[j, :, k], joint[k, :, j] = ahead, ahead.T
            ahead = motion @ ahead
    sees = np.zeros((ROWS, ROWS, N))
    sees[np.arange(ROWS), np.arange(ROWS)] = matrices[:, 0]
    left, all_states = np.eye(ROWS * N) - gains @ sees.reshape(ROWS, ROWS * N), joint.reshape(ROWS * N, ROWS * N)
    errors = (left @ all_states @ left.T + (gains * sizes) @ gains.T).reshape(ROWS, N, ROWS, N)
    most = max(largest(errors[k, :, k], result.covariances[k]) for k in range(ROWS))
    return Ratio(most, most)


def both(true: np.ndarray, claimed: np.ndarray) -> Ratio:
    """The largest ratio, which is also what the ascent follows."""
    most = largest(true, claimed)
    return Ratio(most, most)


RULES: dict[str, Callable[[Reader], Any]] = {
    "CovarianceIntersection": lambda read: hg.CovarianceIntersection(),
    "EqualIntersection": lambda read: hg.fusion.EqualIntersection(),
    "FixedIntersection": lambda read: hg.fusion.FixedIntersection(read.probabilities(COUNT)),
    "TraceIntersection": lambda read: hg.fusion.TraceIntersection(),
    "TraceIntersection, improved": lambda read: hg.fusion.TraceIntersection(improvements=3),
    "WeightedFusion": lambda read: hg.fusion.WeightedFusion(read.probabilities(COUNT)),
}
MESHES = {
    "CovarianceIntersection": hg.CovarianceIntersection(),
    "EqualIntersection": hg.fusion.EqualIntersection(),
    "TraceIntersection": hg.fusion.TraceIntersection(),
}


def families() -> dict[str, Callable[[Numbers], Ratio]]:
    """Ratio of each rule that claims "upper"."""
    return {
        **{name: intersected(rule) for name, rule in RULES.items()},
        "SplitIntersection, known parts apart": split(True),
        "SplitIntersection, known parts together": split(False),
        "what is widened for a quantizer": quantized,
        **{f"{name} between neighbours": neighbours(rule) for name, rule in MESHES.items()},
        "rts_smoother, noise known by bounds": smoothed,
        "mode_known_filter, noise known by bounds": mode_known,
    }


def main(ascents: int) -> int:
    """Ascend, print, and return the number of claims that are broken."""
    broken = 0
    for name, ratio in families().items():
        steps = STEPS if "neighbours" in name or "bounds" in name else 5 * STEPS
        most = max(ascended(ratio, SEED + i, steps).largest for i in range(ascents))
        broken += most > 1 + ROUNDING
        print(f"{name:42} {most:.9f}{'  BROKEN' * (most > 1 + ROUNDING)}", flush=True)
    return broken


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 10) > 0)
