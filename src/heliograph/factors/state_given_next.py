"""A state given the next one, as smoothers use it: the regression of x on x+, and Rauch, Tung and Striebel's step."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import (
    WeightedColumns,
    below_diagonal,
    decorrelate,
    join_columns,
    unit_lower,
)
from heliograph.factors.factored_gaussian import Gaussian, from_columns
from heliograph.factors.pivots import spoils_what_is_known
from heliograph.factors.repeated_measurements import rounding_of_products
from heliograph.factors.scalar_update import update_by_parts, update_by_scalar_given_products
from heliograph.numerics.linalg import where
from heliograph.numerics.types import Float


class BackwardGain(NamedTuple):
    """Regression of x on the next state x+ = m+ + L e: x = m + K e + a noise uncorrelated with e.

    Rauch's smoother gain J = K L^-1 is never formed: an e_j of nearly no variance has a large column of K, which would
    enter every entry of J and cancel again in J (x+ - m+).

    `left` has the mean m and the noise's covariance Cov(x given x+). Shapes: gain K (n, n), ahead m+ = E x+ (n,), lower
    (n (n - 1) / 2,) the entries of L below its diagonal.
    """

    left: Gaussian
    gain: Float[jax.Array, "*time n n"]
    ahead: Float[jax.Array, "*time n"]
    lower: Float[jax.Array, "*time entries"]

    def mean_given(self, later: jax.Array) -> jax.Array:
        """Return E(x given x+ = `later`) = m + K L^-1 (x+ - m+), (n,)."""
        return self.left.mean + self.gain @ self.apply_inverse_factor((later - self.ahead)[:, None])[:, 0]

    def apply_inverse_factor(self, rows: jax.Array) -> jax.Array:
        """Return L^-1 times rows (n, ...): it turns x+ - m+ = L e into e, whose components are uncorrelated."""
        return decorrelate(unit_lower(self.lower), rows)


def condition_on_next_state(x: Gaussian, slopes: jax.Array, ahead: jax.Array, noise: WeightedColumns) -> BackwardGain:
    """Return the regression of a state x on the next one, x+, by measuring x+ part by part.

    A smoother needs x = m + K e + a noise, e the innovations of x+. x = m + L_x xi and x+ = ahead + slopes xi + N omega
    have together the factors [[L_x, 0], [slopes, N]]; xi and omega are uncorrelated, of variances d and r. Each part
    (component) of x+ is measured, with no noise but omega. Its innovation given the parts before it is e_i, its gain
    column i of K (rows of x) and of L (rows of the later parts of x+): x+ = ahead + L e.

    Args:
        x: the state's Gaussian, with L_x (n, n) and d (n,).
        slopes: of x+ in xi, (n, n).
        ahead: the mean of x+, (n,).
        noise: N (n, n), unit lower triangular, as `triangularise` makes it, and r (n,).

    Returns:
        The law of x given x+ (its mean m), K (n, n), the mean of x+, and the entries of L below its diagonal.
    """
    n, root = len(x.mean), jnp.concatenate([x.root, slopes])
    # Var x+_i = sum_j slopes_ij^2 d_j + sum_j N_ij^2 r_j, and the variance up to which slopes of x+ are rounding.
    variances_of_next = slopes**2 @ x.variances + noise.matrix**2 @ noise.weights
    rounding_of_next = rounding_of_products(n, variances_of_next)
    omega_rows, weights = jnp.concatenate([jnp.zeros((n, n), slopes.dtype), noise.matrix]), jnp.asarray(noise.weights)

    def measure_part(
        i: int | jax.Array, root: jax.Array, d: jax.Array, rounding: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Measure part i of x+: return the rows and variances after it, and its gain.

        `root` has the rows of x and below them those of x+, on xi of variances `d`; `rounding`: see `update_by_parts`.
        """
        # N is unit lower triangular, so part i is the first that omega_i is in, and the parts before it have determined
        # omega_0 ... omega_i-1. So it takes one more column than xi has: that of omega_i, with the slope 1 in part i.
        f, column, r = root[n + i], omega_rows[:, i], weights[i]  # Var(part i) = f diag(d) f' + r
        product = d * f
        power = f * product
        # Where the parts before it determine a part, its slopes in xi are their rounding, and count as zero.
        is_rounding = spoils_what_is_known(jnp.sum(power), rounding, r)
        products = jnp.append(where(is_rounding, 0.0, product), r)
        powers = jnp.append(where(is_rounding, 0.0, power), r)
        rows = jnp.concatenate([root, column[:, None]], axis=1)
        rows, d, gain, _ = update_by_scalar_given_products(
            rows, jnp.append(d, r), jnp.append(f, 1.0), (products, powers), jnp.zeros_like(r)
        )
        return rows[:, :n], d[:n], gain

    root, d, gains = update_by_parts(measure_part, root, x.variances, rounding_of_next)
    left = Gaussian(x.mean, below_diagonal(root[:n]), d)
    return BackwardGain(left, gains[:n], ahead, below_diagonal(gains[n:]))


def rts_step(back: BackwardGain, later: Gaussian) -> Gaussian:
    """Smooth x by the smoothed next state: m + J (m_s+ - m+), J P_s+ J' + Cov(x given x+), J = K L^-1.

    `later` is the smoothed law of x+, of mean m_s+ and covariance P_s+. `back` is the regression x = m + K e + noise on
    x+ = m+ + L e; `back.left` has the noise's covariance, Cov(x given x+).

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems (1965).
    """
    of_next_state = WeightedColumns(back.gain @ back.apply_inverse_factor(later.root), later.variances)
    return from_columns(back.mean_given(later.mean), join_columns(of_next_state, back.left.columns))
