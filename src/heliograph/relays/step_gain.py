"""One step's gains while all others stay: the cost is quadratic in them, and its gradient goes back a step."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.relays import Steps
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.types import Array, Float
from heliograph.relays.second_moments import correct, gain_mask, step_moments

DAMPING = 1e-9  # relative, on the change of a gain: decides only what the receiver's error does not


def normal_matrix(
    z: Float[Array, "z z"], ahead: Float[Array, "d d"], p: Steps, damping: float
) -> tuple[Float[jax.Array, "r r"], Float[jax.Array, ""]]:
    """Half the Hessian of tr Lam [I -(0; K)] Z [I -(0; K)]' in the r gains that may be free, damped, and the damping.

    Its entry for the gains ab and cd is Lam_ac Z_bd; 1 on the diagonal of a gain that receives nothing. `damping` is
    relative to the mean of the diagonal.
    """
    rows, columns = np.nonzero(gain_mask(p))
    n, d = p.transition.shape[-1], ahead.shape[0]
    free = jnp.asarray(p.live)[columns]
    normal = jnp.asarray(ahead)[n:, n:][np.ix_(rows, rows)] * z[d:, d:][np.ix_(columns, columns)]
    normal = normal * free[:, None] * free
    trace = jnp.trace(normal)
    added = jnp.where(trace > 0, damping * trace / len(rows), 1.0)  # 1 where nothing hangs on any gain
    return normal + jnp.diag(jnp.where(free > 0, added, 1.0)), added


def best_gain(
    z: Float[Array, "z z"], ahead: Float[Array, "d d"], old: Float[Array, "Fn R"], p: Steps
) -> Float[jax.Array, "Fn R"]:
    """argmin over gains K of tr Lam [I -(0; K)] Z [I -(0; K)]', nearly; all filters together.

    (Lam_ee K Z_ii)_ab = (Lam_e. Z_.i)_ab for each free entry ab: a linear system of the size of the gains.
    """
    rows, columns = np.nonzero(gain_mask(p))
    n, d = p.transition.shape[-1], ahead.shape[0]
    normal, damping = normal_matrix(z, ahead, p, DAMPING)
    cross = ahead[n:] @ z[:d, d:]
    right = (cross[rows, columns] + damping * old[rows, columns]) * p.live[columns]
    return jnp.zeros_like(old).at[rows, columns].set(jnp.linalg.solve(normal, right))


def pull_back(p: Steps, gain: Float[Array, "Fn R"], ahead: Float[Array, "d d"]) -> Float[jax.Array, "d d"]:
    """Gradient of <Lam, moments after the step> with respect to the moments before it (an affine map)."""
    _, pull = jax.vjp(lambda m: correct(step_moments(p, m)[0], gain), jnp.zeros_like(ahead))
    return symmetrize(pull(ahead)[0])
