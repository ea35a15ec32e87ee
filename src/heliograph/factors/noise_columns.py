"""A measurement of a Gaussian in factors, of correlated noises: by uncorrelated combinations, or beside the noises.

Components of uncorrelated noises are N^-1 z, N the unit lower triangle of the noise's factors. Where a noise is only
rounding, N has derivatives as large as one over it, which N^-1 spreads over all columns, to cancel. So what is to be
differentiated has one more column for each noise, of a weight as small as these derivatives are large.
"""

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns, decorrelate
from heliograph.factors.pivots import spoils_what_is_known
from heliograph.factors.repeated_measurements import noise_beside_rounding, rounding_of_products
from heliograph.factors.scalar_update import (
    Measured,
    propagate_slope_rounding,
    stack_numbers,
    update_by_rows,
    update_by_scalar,
)


def measure_uncorrelated(
    root: jax.Array,
    d: jax.Array,
    mean: jax.Array,
    rows: jax.Array,
    noise: WeightedColumns,
    present: jax.Array,
    least: jax.Array,
) -> Measured:
    """Measure z = E z + slopes xi + N omega of x = m + L xi, component after component of N^-1 z.

    xi and omega are uncorrelated, with variances `d` and r. N^-1 z has uncorrelated noises, so that its components can
    be used one by one, each a scalar update without a matrix inverse. Returned are the rows (n + m, n) and variances
    (n,) given all components (L of the posterior, then the slopes), the mean with minus the rest of z - E z below it
    (n + m,), the m innovations, each given those before it, and their variances.

    Args:
        root: L (n, n), the root of the prior covariance L diag(d) L'.
        d: variances (n,) of xi.
        mean: m (n,).
        rows: slopes (m, n), and z - E z as a last column; rows of missing components are 0.
        noise: matrix N (m, m), unit lower triangular, and weights: the variances r (m,) of omega.
        present: which components arrived (m,).
        least: variance (m,) up to which slopes are rounding.
    """
    n = len(d)
    # N^-1 slopes and N^-1 (z - E z); a missing component gets variance 1, with slopes of 0.
    rows, variance = decorrelate(noise.matrix, rows), jnp.where(present, noise.weights, 1.0)
    # Each scalar update changes the rows of L and the slopes of components to come in the same way, so these are
    # stacked. So are the mean and what remains of z - E z, times -1.
    root, mean_and_rest = jnp.concatenate([root, rows[:, :n]]), jnp.concatenate([mean, -rows[:, n]])
    return update_by_rows(root, d, mean_and_rest, variance, least)


def measure_beside_noises(
    root: jax.Array,
    d: jax.Array,
    mean: jax.Array,
    rows: jax.Array,
    noise: WeightedColumns,
    present: jax.Array,
    least: jax.Array,
) -> Measured:
    """Condition x = m + L xi on z = E z + slopes xi + N omega, one component at a time, omega beside xi as unknowns.

    The noises omega become columns of the factor, as the noise of one component also enters later ones. Each component
    is then measured without further noise. `measure_uncorrelated` gives the same results by decorrelating z first.

    Args:
        root: L (n, n), the factor of Cov x = L diag(d) L'.
        d: variances (n,) of xi.
        mean: m (n,).
        rows: slopes (m, n), and z - E z as a last column; 0 of a missing component.
        noise: N (m, m), unit lower triangular, and the variances r (m,) of omega.
        present: which components arrived (m,).
        least: variance (m,) up to which slopes are nothing but rounding.

    Returns:
        Rows (n + m, n) and variances (n,) of xi given all components; the mean (n,), and below it what remains of
        z - E z, times -1; the m innovations, each given the components before it, and their variances.
    """
    n, m = len(d), len(present)
    # Rows [[L, 0], [slopes, N]] on the unknowns (xi, omega), of variances (d, r). A missing component has no noise.
    N, r = jnp.where(present[:, None], noise.matrix, 0.0), jnp.where(present, noise.weights, 0.0)
    of_state = jnp.concatenate([root, jnp.zeros((n, m), N.dtype)], axis=1)
    root = jnp.concatenate([of_state, jnp.concatenate([rows[:, :n], N], axis=1)])
    # The mean and -(z - E z) below it change alike: both gain (their row's gain) times the innovation.
    mean_and_rest, d = jnp.concatenate([mean, -rows[:, n]]), jnp.concatenate([d, r])
    innovations, variances = list[jax.Array](), list[jax.Array]()
    for i in range(m):
        f = root[n + i]  # slopes of component i on (xi, omega), given the components before it
        # Where earlier components leave only rounding of the state's slopes, a huge noise makes the component change
        # nothing. A missing component has slopes of 0, and noise 1 so that nothing is divided by 0.
        is_rounding = spoils_what_is_known(d[:n] @ f[:n] ** 2, least[i], r[i]) if i else jnp.asarray(False)
        other_noise = jnp.where(is_rounding, noise_beside_rounding(n, least[i]), jnp.where(present[i], 0.0, 1.0))
        root, d, gain, total = update_by_scalar(root, d, f, other_noise)
        total = jnp.where(is_rounding, r[i], total)
        innovations.append(-mean_and_rest[n + i])
        variances.append(total)
        mean_and_rest = mean_and_rest + gain * innovations[i]
        least = propagate_slope_rounding(least, gain[n:], least[i] if i else rounding_of_products(n, total))
    return root[:, :n], d[:n], mean_and_rest, stack_numbers(innovations), stack_numbers(variances)
