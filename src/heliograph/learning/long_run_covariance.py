"""Covariance of estimates from scores correlated over time (long-run, sandwich), and quantiles of intervals."""

from typing import Literal, NamedTuple, get_args

import numpy as np
import scipy

from heliograph.numerics.types import Bool, Float


def estimate_long_run_deviation(values: Float[np.ndarray, " steps"]) -> float:
    """Return sqrt(Var(sum of T values) / T) of a series (steps,) that is correlated over time.

    This long-run deviation over sqrt(T) is the standard error of the mean. It is estimated by Bartlett's weights.
    """
    total = estimate_by_bartlett([values[:, None] - values.mean()]).covariance
    return float(np.sqrt(max(total[0, 0], 0.0) / len(values)))


def estimate_mean_and_error(values: Float[np.ndarray, " steps"]) -> tuple[float, float]:
    """Return the mean of a series (steps,) that is correlated over time, and its standard error (NaN of one value).

    Deviations from the mean of the series itself are too small. Of n independent values, the variance that they give
    the sum is too small by the factor (n - 1' W 1 / n) / n, with W the matrix of Bartlett's weights and 1 the vector of
    ones; so it is divided by that. `estimate_by_bartlett` of the ones gives 1' W 1.
    """
    n = len(values)
    if n < 2:
        return float(values.mean()), float("nan")
    weights = estimate_by_bartlett([np.ones((n, 1))]).covariance[0, 0] / n  # 1' W 1 / n
    return float(values.mean()), estimate_long_run_deviation(values) / float(np.sqrt(n - weights))


Method = Literal["cosines", "bartlett", "white", "hessian", "bootstrap", "profile"]
METHODS = get_args(Method)
LEVEL = 0.95
BOOTSTRAP_DRAWS = 999  # of the bootstrap
# Share of the data in which the information on a number lies, below which scores do not tell its spread.
FEW_STRETCHES = 1 / 3

Scores = list[Float[np.ndarray, "steps p"]]


class LongRunCovariance(NamedTuple):
    """Covariance of the sum of scores, and the degrees of freedom with which it is known.

    A score is the gradient of a row's log-likelihood by p numbers. Intervals of estimates take their quantile from
    Student's law with this freedom.
    """

    covariance: Float[np.ndarray, "p p"]
    freedom: float


def count_cosines(steps: int) -> int:
    """Return nu = floor(0.4 T^(2/3)), the number of cosines that estimate the covariance of the scores of T steps."""
    return max(int(0.4 * steps ** (2 / 3)), 1)


def find_numbers_in_few_stretches(information: list[Float[np.ndarray, "steps k"]]) -> Bool[np.ndarray, " k"]:
    """Return which of k numbers have their information in only a few of the nu stretches of the data, (k,).

    Stretches divide the rows evenly, as many as cosines are used to estimate the covariance of summed scores. With V_b
    the information in stretch b, (sum_b V_b)^2 / sum_b V_b^2 is nu if all V_b are equal, and 1 if all but one are 0.
    Below FEW_STRETCHES nu the stretches are few. Scores of such a number differ from 0 only there, where cosines hardly
    change, so that the cosines' estimate misses their variance. `information`: for each recording, the information of
    each row on each number (steps, k).
    """
    by_recording = []
    for rows in information:
        count = count_cosines(len(rows))
        begins = np.arange(count) * len(rows) // count
        by_recording.append(np.add.reduceat(rows, begins, axis=0))  # sums over each stretch
    stretches = np.maximum(np.concatenate(by_recording), 0.0)  # V, (stretches, k)
    return np.asarray(stretches.sum(axis=0) ** 2 < FEW_STRETCHES * len(stretches) * np.sum(stretches**2, axis=0))


def remove_predicted_scores(
    scores: Scores, hessian: Float[np.ndarray, "p p"], in_few_stretches: Bool[np.ndarray, " p"]
) -> tuple[Scores, Float[np.ndarray, "p p"]]:
    """Return the scores minus what the scores of some numbers K predict of them, and the covariance of that prediction.

    These are s - H_.K H_KK^-1 s_K and H_.K H_KK^-1 H_K., with s the scores of each step, H the Hessian of minus the
    log-likelihood and K the numbers marked in `in_few_stretches`. If the model is true, both parts are uncorrelated,
    and the covariances of their sums add up to H.
    """
    K = in_few_stretches
    coefficients = np.linalg.solve(hessian[np.ix_(K, K)], hessian[K])  # H_KK^-1 H_K. (few, p)
    return [s - s[:, K] @ coefficients for s in scores], hessian[:, K] @ coefficients


def estimate_by_cosines(scores: Scores) -> LongRunCovariance:
    """Return the long-run covariance (T/nu) sum_j G_j G_j' of scores, summed over series, and its degrees of freedom.

    For each series s of T steps, G_j = sqrt(2/T) sum_t s_t cos(pi j (t + 1/2)/T) for j = 1..nu = floor(0.4 T^(2/3)).

    Source: Müller, HAC corrections for strongly autocorrelated time series (2014); Lazarus, Lewis, Stock and Watson,
    HAR inference (2018).
    """
    covariances, steps_and_cosines = [], []
    for s in scores:
        steps = len(s)
        count = count_cosines(steps)
        g = np.sqrt(1 / (2 * steps)) * scipy.fft.dct(s, axis=0)[1 : count + 1]  # SciPy's sum has the factor 2
        covariances.append(steps / count * g.T @ g)
        steps_and_cosines.append((steps, count))
    # Each series has nu degrees of freedom. The sum has (sum T)^2 / sum (T^2 / nu), by Satterthwaite's rule.
    total = sum(steps for steps, _ in steps_and_cosines)
    freedom = total**2 / sum(steps**2 / count for steps, count in steps_and_cosines)
    return LongRunCovariance(np.sum(covariances, axis=0), freedom)


def estimate_by_bartlett(scores: Scores) -> LongRunCovariance:
    """Return the long-run covariance of scores with Bartlett's weights, summed over series.

    For each series s of T steps it is sum_|l|<=L (1 - |l|/(L + 1)) sum_t s_t s_(t-l)', with L = ceil(4 (T/100)^(2/9)).

    Source: Newey and West (1987).
    """
    covariances = []
    for s in scores:
        lags = int(np.ceil(4 * (len(s) / 100) ** (2 / 9)))
        products = [s[lag:].T @ s[: len(s) - lag] * (1 - lag / (lags + 1)) for lag in range(min(lags + 1, len(s)))]
        both_ways = [product + product.T for product in products[1:]]
        covariances.append(products[0] + sum(both_ways))
    return LongRunCovariance(np.sum(covariances, axis=0), freedom=np.inf)


def estimate_if_white(scores: Scores) -> LongRunCovariance:
    """Return the covariance of the sum of scores, sum_t s_t s_t', taken for uncorrelated over time (white)."""
    return LongRunCovariance(np.sum([s.T @ s for s in scores], axis=0), freedom=np.inf)  # s: (steps, p)


def bootstrap_block_sums(scores: Scores, draws: int, seed: int) -> Float[np.ndarray, "draws p"]:
    """Return draws of the sum of scores, minus their mean, by a bootstrap of blocks of rows (draws, p).

    Rows are correlated over time, so blocks of 2 T^(1/3) successive ones are drawn with replacement from each series of
    T steps, until they have about T steps in total. The sums of all series are added.

    Args:
        scores: gradients of each row's log-likelihood, (steps, p) for each series.
        draws: number of draws.
        seed: of the random numbers.

    Source: Künsch (1989) for blocks; Hu and Kalbfleisch (2000) for drawing scores in place of data.
    """
    rng = np.random.default_rng(seed)
    total = np.zeros((draws, scores[0].shape[1]))
    for s in scores:
        length = min(max(int(np.ceil(2 * len(s) ** (1 / 3))), 1), len(s))
        running = np.concatenate([np.zeros((1, s.shape[1])), np.cumsum(s, axis=0)])
        block_sums = running[length:] - running[:-length]  # of the block that begins at each step
        # T steps are `count` blocks. Draw a whole number of blocks, and scale the variance to `count`.
        count = len(s) / length
        whole = max(int(count), 1)
        drawn = block_sums[rng.integers(0, len(block_sums), (draws, whole))].sum(axis=1)
        total += (drawn - whole * block_sums.mean(axis=0)) * np.sqrt(count / whole)
    return total


def estimate_long_run_covariance(
    method: Method, scores: Scores, hessian: Float[np.ndarray, "p p"]
) -> LongRunCovariance:
    """Return the covariance of the sum of scores by a method of `Fit.rows`, with its degrees of freedom.

    If the model is right, it is the Hessian of -l, l being the log-likelihood: "hessian" and "profile" take that.

    Args:
        method: how intervals are computed.
        scores: gradients of each row's log-likelihood, (steps, p) for each recording.
        hessian: Hessian of -l (p, p).
    """
    match method:
        case "bootstrap":
            sums = bootstrap_block_sums(scores, BOOTSTRAP_DRAWS, 0)
            return LongRunCovariance(np.atleast_2d(np.cov(sums.T)), freedom=np.inf)
        case "cosines":
            return estimate_by_cosines(scores)
        case "bartlett":
            return estimate_by_bartlett(scores)
        case "white":
            return estimate_if_white(scores)
        case "hessian" | "profile":
            return LongRunCovariance(hessian, freedom=np.inf)


def student_quantile(freedom: float, level: float = LEVEL) -> float:
    """Return how many standard errors an interval of this level reaches to each side: a quantile of Student's law."""
    return float(scipy.stats.t.ppf((1 + level) / 2, freedom))


def find_profile_drop(level: float) -> float:
    """Return by how many nats the profile log-likelihood at the ends of an interval is below its maximum.

    Twice this fall is chi-square with one degree of freedom, so it is half the quantile at `level`.
    """
    return float(scipy.stats.chi2.ppf(level, 1)) / 2


def compute_sandwich_covariance(
    hessian: Float[np.ndarray, "p p"], scores: Float[np.ndarray, "p p"]
) -> Float[np.ndarray, "p p"]:
    """Return the covariance H^-1 J H^-1 of estimates, with H the Hessian of -l (`hessian`).

    J (`scores`) is the covariance of the sum of scores, the gradients of the log-likelihood l by row. If the model is
    right J = H, and this is H^-1.
    """
    half = np.linalg.solve(hessian, scores)  # H^-1 J, and as J is symmetric its transpose is J H^-1
    return np.asarray(np.linalg.solve(hessian, half.T))
