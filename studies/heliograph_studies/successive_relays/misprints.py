"""Small systems on which printed formulas and bounds can be seen to fail."""

from collections.abc import Sequence

import numpy as np

import heliograph as hg
from heliograph_studies.successive_relays.setting import Setting, shadowing

# what each step of Algorithm 1 gives, and what it needs
ORDER = (("covariances at k", ("covariances at k - 1", "gains at k")), ("gains at k", ("covariances at k - 1",)))


def used_before_known(order: Sequence[tuple[str, Sequence[str]]]) -> int:
    """How many quantities an algorithm's steps (what each gives, what it needs) use before they are given."""
    known, early = {"covariances at k - 1"}, 0
    for gives, needs in order:
        early += len(set(needs) - known)
        known.add(gives)
    return early


def without_fading(setting: Setting) -> float:
    """tr P_10 with every gain at its mean."""
    network = setting.network()
    slots = [
        {listener: {s: hg.model.mean_gain(link) for s, link in links.items()} for listener, links in slot.items()}
        for slot in network.slots
    ]
    certain = hg.model.RelayNetwork(network.plant, network.sensor, ("relay_1", "relay_2"), slots)
    return float(hg.relays.local_error_design(certain, 10).trace("receiver")[10])


def alternating(
    plant: hg.LinearPlant, sensor: hg.LinearSensor, law: hg.random_affine.LogNormal, relay: float, remote: float
) -> hg.model.RelayNetwork:
    """Two relays in turn over one law of gains, with these noises at relay and remote filter."""
    slots = [
        {item: {"sensor": hg.hop(law, relay), other: hg.hop(law, 0.0)}, "receiver": {other: hg.hop(law, remote)}}
        for item, other in (("relay_2", "relay_1"), ("relay_1", "relay_2"))
    ]
    return hg.model.RelayNetwork(plant, sensor, ("relay_1", "relay_2"), slots)


def largest_noise() -> float:
    """Smallest eigenvalue of Xi_1 at k = 40 where relays receive next to nothing and noise is unequal."""
    plant = hg.LinearPlant(0.1 * np.eye(2), np.diag([0.01, 1.0]), np.zeros(2), 0.01 * np.eye(2))
    sensor = hg.LinearSensor([[1.0, 1.0]], [[1.0]])
    network = alternating(plant, sensor, shadowing(0.5, 0.1), 1e6, 1e6)
    return float(np.linalg.eigvalsh(hg.relays.local_error_design(network, 40).covariance["relay_1"][-1])[0])


def noise_squared() -> dict[str, object]:
    """P_4 of a scalar system with O = 100, and (52) with o = O^2 and with o = O."""
    tau, w, noise, order = 0.81, 1e-6, 100.0, 4
    plant, sensor = hg.LinearPlant([[0.9]], [[w]], [0.0], [[10.0]]), hg.LinearSensor([[1.0]], [[1e-6]])
    network = alternating(plant, sensor, shadowing(1.0, 1e-6), 1e-6, noise)
    bounds, upper = [10.0, 10.0], 10.0
    for _ in range(order):
        factors = [o / (o + 4 * upper) for o in (noise**2, noise)]
        bounds = [tau * factor * bound + w for factor, bound in zip(factors, bounds, strict=True)]
        upper = tau * upper + w
    error = float(hg.relays.local_error_design(network, order).trace("receiver")[-1])
    return {"error": error, "order": order, "bounds": bounds}


def printed_scalar() -> dict[str, float]:
    """Lemmas 8 and 9 as printed on x+ = 0.5 x + w, W = V = Psi = 1, P_0 = 10, G = O = 1e6, means 0.5, var 0.1."""
    tau, w, p0, noise, mu, phi = 0.25, 1.0, 10.0, 1e6, 0.5, 0.1
    upper = tau * p0 + w / (1 - tau)
    n, weight = (mu**2 + phi) * (1 + 1) + noise, 2 * mu**2 * (2 * tau + 3) * upper
    rho = tau * (n - weight * mu**2 / phi) / (n + weight)
    alpha = tau * noise / (noise + 4 * mu**2 * upper)
    # varrho below 1: the largest that (45) allows with s -> 0 is phi / (phi + mu^2)
    left = phi / (phi + mu**2)
    return {
        "upper": upper,
        "receiver": alpha * p0 + w / (1 - alpha),
        "relay": rho * p0 + left * w / (1 - rho),
    }
