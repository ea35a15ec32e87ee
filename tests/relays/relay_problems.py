"""The oracle's problems as relay networks, and one of another kind."""

import numpy as np

from heliograph.model.channel import amplify_and_forward, hop
from heliograph.model.over_time import over_time
from heliograph.model.plant import LinearPlant
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import LinearSensor
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.fading import LogNormal
from heliograph.random_affine.laws.law import GivenMoments, bernoulli
from heliograph.random_affine.noises.noise import Gaussian
from tests.oracles import successive_relays as oracle

RELAYS = ("relay_1", "relay_2")


def network_of(p: oracle.Problem) -> RelayNetwork:
    """Two alternating relays with everything varying in time, from the oracle's arrays."""
    n_steps, m = len(p.Gam), p.Psi.shape[1]
    plants = [LinearPlant(p.Gam[k], p.Sigma[k] @ p.W[k] @ p.Sigma[k].T, p.xbar0, p.P0) for k in range(n_steps)]
    sensors = [LinearSensor(p.Psi[k], p.Theta[k] @ p.V[k] @ p.Theta[k].T) for k in range(1, n_steps + 1)]

    def link(k, c, noise):
        return GainAndNoise(GivenMoments([p.mean[k, c], p.var[k, c] + p.mean[k, c] ** 2]), np.eye(m), noise)

    slots = []
    for k in range(1, n_steps + 1):
        i, j = oracle.turns(k)
        local = {"sensor": link(k, i, p.G[k, i]), RELAYS[j]: link(k, 2, np.zeros((m, m)))}
        slots.append({RELAYS[i]: local, "receiver": {RELAYS[j]: link(k, 3 + j, p.O[k, j])}})
    return RelayNetwork(over_time(plants), over_time(sensors), RELAYS, slots)


def gains_of(K, L):
    """The oracle's gains, (N + 1, n, m), by filter."""
    gains = {name: np.zeros_like(K[1:]) for name in RELAYS}
    for k in range(1, len(K)):
        gains[RELAYS[oracle.turns(k)[0]]][k - 1] = K[k]
    return gains | {"receiver": L[1:]}


def example() -> RelayNetwork:
    """Section IV's circuit, with two slots in turn."""

    def link(mean, noise):
        spread = np.log(1 + 0.01 / mean**2)
        return hop(LogNormal(np.log(mean) - spread / 2, np.sqrt(spread)), noise)

    p = oracle.section_iv(1)
    plant = LinearPlant(p.Gam[0], p.Sigma[0] @ p.W[0] @ p.Sigma[0].T, p.xbar0, p.P0)
    sensor = LinearSensor(p.Psi[0], p.Theta[0] @ p.V[0] @ p.Theta[0].T)
    s = 4e-6
    odd = {"relay_2": {"sensor": link(0.92, s), "relay_1": link(0.9, 0.0)}, "receiver": {"relay_1": link(0.9, s)}}
    even = {"relay_1": {"sensor": link(0.9, s), "relay_2": link(0.9, 0.0)}, "receiver": {"relay_2": link(0.92, s)}}
    return RelayNetwork(plant, sensor, RELAYS, (odd, even))


def unusual() -> RelayNetwork:
    """Three relays, three slots: full duplex with self-interference, a direct link, an idle slot for one relay.

    Two-dimensional signals; noises with means; links whose gain and noise are dependent (an amplifying second hop).
    """
    rng = np.random.default_rng(5)
    a, b = (rng.normal(size=(2, 2)) for _ in range(2))
    plant = LinearPlant(rng.normal(size=(3, 3)) * 0.4, Gaussian(np.eye(3) * 0.3 + 0.1, [0.2, -0.1, 0.3]),
                        [1.0, -0.5, 0.2], np.diag([1.0, 0.5, 0.2]))  # fmt: skip
    sensor = LinearSensor(rng.normal(size=(2, 3)), Gaussian(a @ a.T + 0.1 * np.eye(2), [0.5, -0.3]))

    def link(mean, noise=0.2):
        return hop(LogNormal(np.log(mean), 0.3), Gaussian(noise * np.eye(2) + 0.05 * b @ b.T, [0.1, -0.2]))

    chain = amplify_and_forward([link(0.8), link(0.7)])
    lossy = GainAndNoise(bernoulli(0.7), rng.normal(size=(2, 2)), 0.1 * np.eye(2))
    slots = (
        {"a": {"sensor": link(0.9), "a": link(0.1), "b": chain}, "b": {"sensor": lossy, "c": link(0.3)},
         "receiver": {"a": chain, "sensor": link(0.2, 2.0)}},
        {"b": {"a": link(0.6), "sensor": link(0.4)}, "c": {"b": lossy}, "receiver": {"c": link(0.9)}},
        {"a": {"c": link(0.5)}, "c": {"sensor": chain}, "receiver": {"a": link(0.5), "b": lossy}},
    )  # fmt: skip
    return RelayNetwork(plant, sensor, ("a", "b", "c"), slots)


def relative(a, b) -> float:
    """Largest difference over the stack, each matrix relative to its largest entry."""
    a, b = np.asarray(a), np.asarray(b)
    return float(np.max(np.abs(a - b).max(axis=(-2, -1)) / np.abs(b).max(axis=(-2, -1))))
