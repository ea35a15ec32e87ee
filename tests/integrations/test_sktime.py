"""The transformer for sktime, where that is installed: sktime's own checks, and the numbers of the filter alone."""

import re
import tracemalloc
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import heliograph as hg

pytest.importorskip("sktime")
FOLDER = Path(__file__).parents[2] / "integrations" / "sktime"
PLANT = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], 0.01 * np.eye(2), [0.0, 0.0], np.eye(2))
TREND = hg.kalman_filter(PLANT, hg.LinearSensor([[1.0, 0.0]], 0.1))


@pytest.fixture
def module(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return import_module("heliograph_sktime")


def test_each_series_has_the_estimates_of_the_filter_alone(module, monkeypatch):
    """Also over the ends of blocks, and where values did not arrive."""
    monkeypatch.setattr(module, "BLOCK", 4)
    z = np.random.default_rng(0).normal(size=(10, 1, 12))
    z[3, 0, 5] = np.nan
    found = module.FilterTransformer(TREND, deviations=True).fit_transform(z)
    for series, states in zip(z, found, strict=True):
        alone = TREND.run(series[0])
        np.testing.assert_allclose(states[:2].T, alone.means, rtol=1e-10, atol=1e-12)  # compiled apart: rounding
        deviation = np.sqrt(np.diagonal(np.asarray(alone.covariances), axis1=1, axis2=2))
        np.testing.assert_allclose(states[2:].T, deviation, rtol=1e-10)


def test_a_panel_of_other_columns_is_one_line(module):
    with pytest.raises(ValueError, match="X: expected 1 columns, as the filter receives, got 2"):
        module.FilterTransformer(TREND)._transform(np.zeros((3, 2, 5)))


@pytest.mark.slow
def test_memory_beyond_panel_and_estimates_does_not_grow_with_the_series(module):
    """Of a hundred thousand, as of five thousand: a few blocks of 1,024 at the peak."""
    beyond = {}
    for count in (5_000, 100_000):
        panel = np.random.default_rng(0).normal(size=(count, 1, 50))
        module.FilterTransformer(TREND)._transform(panel[:2048])  # compiled
        tracemalloc.start()
        states = module.FilterTransformer(TREND)._transform(panel)
        beyond[count] = tracemalloc.get_traced_memory()[1] - states.nbytes
        tracemalloc.stop()
        assert states.shape == (count, 2, 50)
    block = 1024 * 50 * (1 + 2) * 8
    assert beyond[100_000] < 6 * block and beyond[100_000] < 1.5 * beyond[5_000]


@pytest.mark.slow
def test_sktime_finds_nothing_wrong(module):
    from sktime.utils.estimator_checks import check_estimator

    found = check_estimator(module.FilterTransformer, raise_exceptions=False, verbose=False)
    assert len(found) > 200 and {name: said for name, said in found.items() if said != "PASSED"} == {}


@pytest.mark.slow
def test_the_page_runs(module):
    (block,) = re.findall(r"```python\n(.*?)```", (FOLDER / "README.md").read_text(), re.DOTALL)
    exec(block, {})
