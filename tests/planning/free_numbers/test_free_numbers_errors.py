"""Errors of every kind of networks that are functions of numbers: gradients, and designs as those by powers."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.planning import Budget, Error
from heliograph.planning.free_numbers.problem import FreeNumberProblem, make_free_numbers
from tests.planning.free_numbers.test_free_numbers import (
    CASES,
    FADING,
    PLANT,
    check_gradients,
    observed_modes,
    uncertain,
)

SENSORS = {"p": hg.LinearSensor([[1.0, 0.0]], 0.2), "q": hg.LinearSensor([[0.0, 1.0]], 0.4)}
NOISES = {"p": 0.3, "q": 0.6}


def two(**amplifications):
    """A hop each, with one amplification or one for each step."""

    def channel(name, a):
        if jnp.ndim(a) == 0:
            return hg.hop(FADING, NOISES[name], amplification=a)
        return hg.model.over_time([hg.hop(FADING, NOISES[name], amplification=item) for item in a])

    return hg.Network(PLANT, {n: hg.Node(SENSORS[n], channel(n, a), {}) for n, a in amplifications.items()})


BY_STEP = {"p": ([1.0, 2.0], 1e-3, 9.0), "q": ([1.5, 0.7], 1e-3, 9.0)}
CONSTANT = {"p": (1.0, 1e-3, 9.0), "q": (1.0, 1e-3, 9.0)}
UNSTABLE = hg.LinearPlant([[1.2, 0.2], [0.0, 0.7]], np.diag([0.1, 0.3]), [1.0, 2.0], np.eye(2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "free", "error"),
    [
        (observed_modes, CASES["observed modes"][1], Error(horizon=3, at_end=True)),
        (uncertain, CASES["uncertain"][1], Error(horizon=3)),
        (two, BY_STEP, Error(period=2, worst=True)),
    ],
)
def test_gradients_of_every_error_are_those_of_differences(build, free, error):
    check_gradients(FreeNumberProblem(build, make_free_numbers(free), error))


@pytest.mark.parametrize(
    ("free", "options"),
    [
        (
            CONSTANT,
            {"error": Error({"x1": 1.0}), "target_error": 0.27, "budget": Budget(per_transmitter={"q.hop1": 2.8})},
        ),
        (
            BY_STEP,
            {"error": Error(horizon=2, at_end=True), "budget": Budget(1, per_transmitter={"q.hop1": 0.4}, peak=0.9)},
        ),
        (BY_STEP, {"error": Error(period=2), "target_error": 0.6}),
    ],
)
def test_designs_are_those_by_powers(free, options):
    """Error, power, price and sensitivities; 1e-6 of powers and prices, which a flat optimum tells less exactly."""
    result, best = hg.design(two, free=free, starts=1, **options), hg.design(two(p=1.0, q=1.0), **options)
    assert result.error == pytest.approx(best.error, rel=1e-7) and result.total == pytest.approx(best.total, rel=1e-6)
    assert result.present > 0 and result.covariance.shape == best.covariance.shape
    sends = [name for name, power in best.powers.items() if power.mean() > 1e-3]
    for name in sends:
        assert result.sensitivity[name] == pytest.approx(best.sensitivity[name], rel=1e-5)
    assert result.price == pytest.approx(best.price, rel=1e-5)
    assert result.certificate.stationarity < 1e-6
    assert result.certificate.words.startswith("best of the one start, stationary within")
    if options["error"].period > 1:  # it runs on, and sends what it should
        assert hg.power(result.network, horizon=40).mean["p.hop1"] == pytest.approx(
            result.powers["p.hop1"].mean(), rel=0.1
        )


def test_without_a_limit_of_power_a_watt_is_worth_nothing_and_the_inner_optimum_is_stationary():
    """A gain that may be known better or worse: the least error is inside, where its gradient vanishes."""

    def at(p):
        return two(p=1.0 + 0.0 * p, q=1.0 / (1.0 + (p - 0.4) ** 2))

    result = hg.design(at, free={"p": (0.1, -1.0, 1.0)}, starts=1)
    assert result.numbers["p"] == pytest.approx(0.4, abs=1e-5) and result.certificate.stationarity < 1e-6
    assert result.price == 0.0 and set(result.sensitivity.values()) == {0.0}


@pytest.mark.parametrize(
    ("build", "free", "options", "message"),
    [
        (
            two,
            CONSTANT,
            {"target_error": 0.1},
            r"target error: expected at least 0\.\d+, the least found from 1 starts, got 0",
        ),
        (
            two,
            CONSTANT | {"q": (1.0, 0.5, 2.0)},
            {"budget": 1e-3},
            r"budget: expected one that is met .* total power of",
        ),
        (two, BY_STEP, {"budget": 1, "error": Error(period=3)}, "as many steps as the error's period, 3, got 2"),
        (two, BY_STEP, {"budget": 1, "error": Error(horizon=4)}, "horizon: expected at most 2.*got 4"),
        (
            lambda a: hg.Network(UNSTABLE, {"p": hg.Node(SENSORS["p"], hg.hop(FADING, 0.3, amplification=a), {})}),
            {"a": (1.0, 0.1, 2.0)},
            {"budget": 1},
            r"steady power: expected a stable plant, or a horizon.*got spectral radius 1\.2",
        ),
    ],
)
def test_what_cannot_be_is_said_in_one_line(build, free, options, message):
    with pytest.raises(ValueError, match=message):
        hg.design(build, free=free, starts=1, **options)
