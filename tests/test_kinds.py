"""Numbers in arrays of any kind mean the same: of NumPy in whatever order and type, of JAX, pandas, xarray, masked."""

import jax
import numpy as np
import pytest
import xarray as xr

import heliograph as hg
from tests.junk import KALMAN, KINDS, NODE, PLANT

EYE = np.eye(2)
NETWORK = hg.Network(PLANT, {"a": NODE})
# What is called, and numbers that are the same in single precision.
CALLS = {
    "plant": (lambda x: hg.LinearPlant(x, EYE, [0.0, 0.0], EYE), 0.5 * EYE),
    "noise": (lambda x: hg.LinearPlant(EYE, x, [0.0, 0.0], EYE), 0.5 * EYE),
    "mean": (lambda x: hg.LinearPlant(EYE, EYE, x, EYE), [0.5, -2.0]),
    "sensor": (lambda x: hg.LinearSensor(x, 0.5), [[1.0, 0.25]]),
    "law": (lambda x: hg.Discrete(x, [0.5, 0.5]), [0.25, 1.0]),
    "chances": (lambda x: hg.Discrete([1.0, 2.0], x), [0.25, 0.75]),
    "gain": (lambda x: hg.hop(x, 0.5), 0.25),
    "power": (lambda x: hg.hop(1.0, 0.5, power=x), 0.25),
    "arrival": (lambda x: hg.dropout(hg.hop(1.0, 0.5), x), 0.25),
    "clock": (lambda x: hg.model.with_clocks(PLANT, {"a": NODE.sensor}, {"a": hg.model.Clock(x, 0.5)},
                                             [[0.0, 1.0], [0.0, 0.0]], 0.5)[0], 0.25),
    "weights": (lambda x: hg.fusion.WeightedFusion(x), [0.25, 0.75]),
    "quantizer": (lambda x: hg.fusion.UniformQuantizer(8, x), [0.5, 2.0]),
    "levels": (lambda x: hg.fusion.level_weights(x), [1.0, 2.0]),
    "likelihood": (lambda x: hg.log_likelihood(KALMAN, x), [[0.5], [0.25], [-1.0]]),
    "push": (lambda x: hg.Stream(KALMAN).push(x), [0.5]),
    "run": (lambda x: hg.run(NETWORK, {"a": x}).estimates["a"]["f"].mean, [[0.5], [0.25], [-1.0]]),
    "times": (lambda x: hg.run(NETWORK, {"a": [0.5, 0.25, 1.0]}, time=x).time, [0.5, 1.0, 1.5]),
    "signal": (lambda x: hg.simulation.transmit(x, hg.hop(1.0, 0.5), 0), [[0.5], [0.25], [-1.0]]),
}  # fmt: skip


def numbers_of(result):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(result) if isinstance(leaf, np.ndarray | jax.Array | float)]


@pytest.mark.parametrize("of", CALLS)
def test_numbers_of_any_kind_mean_the_same(of):
    call, plain = CALLS[of]
    expected = numbers_of(call(np.array(plain)))
    for kind, made in KINDS.items():
        value = made(np.array(plain))
        if of == "push" and kind in ("objects", "decimals"):
            with pytest.raises(ValueError, match="measurement: expected 1 number, got"):
                call(value)
            continue
        found = numbers_of(call(value))
        assert [a.dtype for a in found] == [b.dtype for b in expected], kind
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_array_equal(a, b, err_msg=kind)


# One of each class of what once raised something else than a line.
NO_NUMBERS = [xr.Dataset({"a": ("t", [1.0])}), jax.random.key(0), np.array([10**400], dtype=object)]


@pytest.mark.parametrize("of", ["noise", "gain", "quantizer", "likelihood", "push", "run", "signal"])
@pytest.mark.parametrize("value", NO_NUMBERS, ids=["set of arrays", "key", "too large"])
def test_what_is_no_array_of_numbers_is_refused_in_one_line(of, value):
    with pytest.raises(ValueError, match=r"^[^\n]*: expected [^\n]*number[^\n]*, got [^\n]*$"):
        CALLS[of][0](value)


def test_events_of_a_timeline_are_numbers():
    for value in NO_NUMBERS:
        with pytest.raises(ValueError, match=r"event of 'a': expected 1 number, got"):
            hg.Timeline(NETWORK, 3).push("a", 0, 0, value)


def test_correlations_do_not_depend_on_the_unit():
    """Squares of 1e300 are no numbers; those of the same innovations in another unit are."""
    z = np.sin(np.arange(60.0) ** 2)[:, None]
    small, large = (hg.simulation.memory_test(unit * z, KALMAN, lags=3) for unit in (1.0, 2.0**1000))
    np.testing.assert_allclose(large.correlation, small.correlation, rtol=1e-12)
    assert large.power == np.inf
    with pytest.raises(ValueError, match="data: expected innovations that are finite numbers of their deviations"):
        hg.simulation.memory_test(np.where(z > 0, 1e308, -1e308), KALMAN, lags=3)


def test_settings_are_true_or_false():
    for call in (
        lambda: hg.h_infinity.check_growth(lambda x: x, 1.0, [-1.0], [1.0], differences=np.zeros(0)),
        lambda: hg.files.read_messages("a.csv", NETWORK, strict="no"),
    ):
        with pytest.raises(ValueError, match="expected True or False, got"):
            call()


def test_a_level_too_low_for_a_number_is_no_level():
    plant, sensor = PLANT.matrix, [[1.0, 0.5]]
    system = hg.h_infinity.growth_system(
        3, [[0.2], [0.1]], [[0.3]], EYE, hg.hop(1.0, 0.1), 0.0, transition=plant, output=sensor, initial_weight=5.0
    )
    start = 5.0 * np.eye(4)
    for level in (1e-300, 1e-160):
        found = hg.h_infinity.recursive_design(system, level, start, search=False)
        assert not found.feasible and found.status == "the initial condition 0 < P_0 < level^2 W fails"


def test_a_source_is_told_its_plant_and_numbers_in_their_kinds():
    for wrong in (np.zeros(0), 0, {}):
        with pytest.raises(ValueError, match="json_field, plant: expected a text"):
            hg.files.json_field("value", "a", plant=wrong)
    for wrong in NO_NUMBERS[:2]:
        with pytest.raises(ValueError, match="json_field, scale: expected 1 number, or 1, got"):
            hg.files.json_field("value", "a", scale=wrong)
