"""Rows in blocks, each after the result of the one before: the results of one run."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

ROWS = 90
RNG = np.random.default_rng(5)
Z = np.cumsum(RNG.normal(size=(ROWS, 1)), axis=0)
Z[[4, 31, 60]] = np.nan
WALK = hg.LinearPlant([[1.0, 0.1], [0.0, 1.0]], np.diag([1e-3, 0.1]), np.zeros(2), np.eye(2))
PLACE = hg.LinearSensor([[1.0, 0.0]], [[0.5]])
RISING = hg.model.over_time([hg.LinearSensor([[1.0 + 0.01 * k, 0.0]], [[0.5]]) for k in range(ROWS)])


def in_blocks(item, z, ends):
    """Run rows up to each of these ends, one block after the other; return all results."""
    results, begin = list[hg.filters.Filtered](), 0
    for end in [*ends, len(z)]:
        results.append(item.run(z[begin:end], after=results[-1] if results else None))
        begin = end
    return results


@pytest.mark.parametrize(
    "item",
    [
        hg.kalman_filter(WALK, PLACE),
        hg.kalman_filter(WALK, RISING),
        hg.linear_filter(WALK, PLACE, hg.hop(hg.Discrete([0.5, 1.2], [0.4, 0.6]), 0.1)),
        hg.extended_filter(WALK, hg.Sensor(lambda x: jnp.sin(x[:1] / 20), [[0.5]], ["angle"])),
    ],
    ids=["Kalman", "a sensor that varies over time", "moments before data", "extended"],
)
def test_blocks_are_one_run(item):
    """To the last bit but for a rounding or two: the programs differ."""
    whole, blocks = item.run(Z), in_blocks(item, Z, [1, 40])
    for name in ("means", "covariances", "innovations", "innovation_covariances", "log_likelihoods"):
        joined = np.concatenate([getattr(block, name) for block in blocks])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=1e-12, atol=1e-12)
    assert sum(block.log_likelihood for block in blocks) == pytest.approx(whole.log_likelihood, rel=1e-12)
    assert blocks[-1].origin.step == whole.origin.step == ROWS
    assert blocks[-1].origin.time == whole.origin.time == ROWS - 1


def test_long_blocks_go_in_chunks_from_where_the_one_before_ended():
    """To 1e-10 of a deviation, of which a speed has 0.2 here."""
    z = np.cumsum(RNG.normal(size=(70_000, 1)), axis=0)
    item = hg.kalman_filter(WALK, PLACE)
    whole, blocks = item.run(z), in_blocks(item, z, [35_000])
    np.testing.assert_allclose(np.concatenate([block.means for block in blocks]), whole.means, rtol=1e-11, atol=1e-11)
    assert sum(block.log_likelihood for block in blocks) == pytest.approx(whole.log_likelihood, rel=1e-12)


def test_rows_after_others_are_behind_them_and_of_the_same_filter():
    item = hg.kalman_filter(WALK, PLACE)
    first = item.run(Z[:10])
    with pytest.raises(ValueError, match=r"after.*returned for the rows before.*another filter"):
        hg.kalman_filter(hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 1.0)).run(Z, after=first)
    with pytest.raises(ValueError, match=r"after.*returned for the rows before"):
        item.run(Z, after=Z)
    with pytest.raises(ValueError, match=rf"at most {ROWS} steps.*{ROWS + 1}"):
        varying = hg.kalman_filter(WALK, RISING)
        varying.run(Z[:1], after=varying.run(Z))


def test_dates_of_rows_after_others_are_later():
    pd = pytest.importorskip("pandas")
    item = hg.kalman_filter(WALK, PLACE)
    table = pd.DataFrame({"z": Z[:20, 0]}, index=pd.date_range("2024-01-01", periods=20, freq="D"))
    first = item.run(table[:10])
    assert item.run(table[10:], after=first).origin.time == np.datetime64("2024-01-20")
    with pytest.raises(ValueError, match="rows behind 2024-01-10"):
        item.run(table[9:], after=first)
