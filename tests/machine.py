"""The induction machine of the cubature-fusion publication, from the oracle's constants, as a heliograph network."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from tests.oracles.relayed_machine import PRINTED, STRONG, Setting, simulate

NUMBERS = ["b1", "b2", "b3", "b4", "b5", "b6", "h", "k1", "k2", "k3"]


class Transition(eqx.Module):
    """The machine's step; its numbers are arrays, so that settings share what is compiled."""

    numbers: dict[str, np.ndarray]

    def __call__(self, x, u):
        b1, b2, b3, b4, b5, b6, h, k1, k2, k3 = (self.numbers[name] for name in NUMBERS)
        rates = [
            b1 * x[0] + k1 * x[1] + b2 * x[2] + k2,
            -k1 * x[0] + b1 * x[1] + b2 * x[3],
            b3 * x[0] + b4 * x[2] + (k1 - x[4]) * x[3],
            b3 * x[1] - (k1 - x[4]) * x[2] + b4 * x[3],
            b5 * (x[0] * x[3] - x[1] * x[2]) + b6 * k3,
        ]
        return x + h * jnp.stack(rates)


def transition(s: Setting):
    return Transition({name: np.asarray(s[name]) for name in NUMBERS})


def plant(s: Setting):
    return hg.Plant(transition(s), s["R"], s["xbar0"], s["P0"])


def sensor(s: Setting, node: int):
    return hg.LinearSensor(s["C"][node], s["Q"])


def law(s: Setting, name: str, radius: float | None = None):
    values, p, r = s[name]
    return hg.Discrete(values, p, r if radius is None else radius)


def channel(s: Setting, radius: float | None = None):
    return hg.amplify_and_forward(
        [
            hg.hop(law(s, "gamma", radius), s["Qm"], power=s["El"]),
            hg.hop(law(s, "xi", radius), s["Qn"], power=s["Er"], amplification=s["alpha"]),
        ]
    )


def start(s: Setting, node: int):
    return {"initial_mean": s["xhat0"][node], "initial_covariance": s["Xi0"]}


def data(s: Setting, steps: int = 6, seed: int = 0):
    laws = (s["xi"][1], s["gamma"][1])
    return simulate({**s, "T": steps}, 1, np.random.default_rng(seed), laws)["ybar"][0]


__all__ = ["PRINTED", "STRONG", "channel", "data", "law", "plant", "sensor", "start", "transition"]
