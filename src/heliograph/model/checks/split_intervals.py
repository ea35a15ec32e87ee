"""Whether a row in between may split an interval of time: parts of a model, and predictions, that this would change."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.model.trigger import AbstractTrigger
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.memories_of_channels import memories

CUTS = ((0.0, 1.0), (0.25, 0.75), (1.0, 0.0))  # of an interval of length one, in the plant's own unit
TOLERANCE = 1e-9  # relative: a few products lose 1e-15


def find_indivisible_part(
    plant: AnyPlant | None,
    sensor: AnySensor | None = None,
    channel: Channel | None = None,
    trigger: AbstractTrigger | None = None,
) -> str:
    """Return in words, for an error, the part of a model whose law counts steps and not time; "" if there is none.

    Inserting a row would change such a law.

    Args:
        plant: the plant; this and the others may be None, and are then not looked at.
        sensor: its sensor.
        channel: the channel of its signal.
        trigger: the rule by which the sender decides to send.
    """
    if plant is not None and memories(plant):
        return "a plant with modes, whose law a row that is inserted would change"
    if sensor is not None and memories(sensor):
        return "a sensor with modes"
    if channel is not None and first(channel).remembers:
        return "a channel that remembers"
    return "" if trigger is None else "a sender with a trigger"


def explain_uneven_prediction(plant: AbstractPlant, dt: int) -> str:
    """Explain how a plant's prediction over an interval differs from that over its parts; "" if it does not.

    Data at irregular times cut an interval anywhere, and the prediction must not depend on that. With the motion f, its
    Jacobian A and the noise covariance Q: f(f(x, s), t) = f(x, s + t), A(s + t) = A(t) A(s), Q(s + t) = A(t) Q(s) A(t)'
    + Q(t). These are tested around the initial mean, with all other inputs 1; s = 0 and t = 0 are among the divisions.

    Args:
        plant: the plant, whose time step is an input.
        dt: index of this input.
    """
    mean, deviation = np.asarray(plant.initial_mean), np.sqrt(np.diag(np.asarray(plant.initial_covariance)))
    cuts = np.array(CUTS)
    # At the initial mean, and one standard deviation from it.
    for x in (mean, mean + deviation):
        # f, A and Q, each with an axis of cuts: over s + t as one interval, and over s and then t.
        sums = cuts.sum(axis=1, keepdims=True)  # s + t of each cut (s, t)
        whole = _predict_over_intervals(plant, dt, x, sums)
        parts = _predict_over_intervals(plant, dt, x, cuts)
        for i, (s, t) in enumerate(CUTS):
            for what, at_once, in_two in zip(("transition", "Jacobian", "noise"), whole, parts, strict=True):
                gap = float(np.abs(at_once[i] - in_two[i]).max())
                if not gap <= TOLERANCE * max(1.0, float(np.abs(at_once[i]).max())):
                    return (
                        f"{what} over {s:g} and then {t:g} differs by {gap:.3g} from that over {s + t:g}; give the "
                        "plant a function, and a noise, of dt that agree over the parts of an interval"
                    )
    return ""


@compile_on_call
def _predict_over_intervals(
    plant: AbstractPlant, dt: int, x: Float[Array, " n"], intervals: Float[Array, "cut part"]
) -> tuple[Float[Array, "cut n"], Float[Array, "cut n n"], Float[Array, "cut n n"]]:
    """Return the mean, transition matrix and noise covariance after some intervals of time, passed one after another.

    If a span of time gives the same whether it is cut or not, data may add steps in between.

    Args:
        plant: the plant.
        dt: number of the input that is the length of an interval; all other inputs are 1.
        x: mean at the start (n,).
        intervals: [c, p], length of interval p of the cut c of a span of time, in the plant's unit.

    Returns:
        For each cut the mean (n,), the product of the transition matrices and the noise's covariance (n, n).
    """

    def integrate(intervals: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the mean, transition matrix and noise covariance after intervals of these lengths, one after another.

        From outside: `x`, the mean before them, and `dt`, the number of the input that is the length. All other inputs
        are 1.
        """
        n = len(x)
        mean, matrix, covariance = jnp.asarray(x), jnp.eye(n), jnp.zeros((n, n))
        for interval in intervals:
            # The step over one interval: F = df/dx at the mean, with angles kept continuous.
            u = jnp.where(np.arange(len(plant.inputs)) == dt, interval, 1.0)
            F = jax.jacfwd(plant.make_motion_about(u, mean))(mean)
            predicted = plant.transition(mean, u)
            mean = plant.manifold.settle(predicted, predicted + plant.noise_mean())
            # F F_before, and F P F' + Q of the noise so far.
            matrix = F @ matrix
            covariance = F @ covariance @ F.T + plant.noise_covariance(u)
        return mean, matrix, covariance

    moved: tuple[jax.Array, jax.Array, jax.Array] = jax.vmap(integrate)(jnp.asarray(intervals))
    return moved
