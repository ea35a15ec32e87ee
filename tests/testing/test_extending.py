"""What a class of one's own lacks is said in one line; what its methods return is taken as the page says."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.testing import check_quantizer, check_random_affine
from tests.junk import without_checker

ABSTRACT = [
    hg.random_affine.AbstractLaw, hg.random_affine.AbstractRandomAffine, hg.random_affine.AbstractNoise,
    hg.filters.AbstractFilter, hg.filters.AbstractTransform, hg.filters.AbstractUpdate, hg.fusion.AbstractFusion,
    hg.fusion.AbstractQuantizer, hg.smoothing.AbstractSmoothing, hg.simulation.AbstractReducer,
]  # fmt: skip


@pytest.mark.parametrize("kind", ABSTRACT)
def test_a_method_that_is_not_written_is_named(kind):
    """Every method of the base class, called with anything: it works, or a line names what is missing or wrong."""
    empty = {name: () for name in getattr(kind, "__abstractvars__", ())}
    bare = object.__new__(type("Mine", (kind,), {"__module__": __name__, **empty}))
    missing = []
    for name, method in inspect.getmembers(kind, inspect.isfunction):
        if name.startswith("_") or "unwritten" not in inspect.getsource(method):
            continue
        nothing = [None] * (len(inspect.signature(method).parameters) - 1)
        with without_checker(), pytest.raises(ValueError) as raised:
            method(bare, *nothing)
        assert str(raised.value) == f"Mine: expected a method {name} of its own, as its base class says, got none"
        missing.append(name)
    assert missing


class Turn(hg.random_affine.AbstractRandomAffine):
    """z = -y or y, by a fair coin; `form` makes of the matrix of moments what `moments` returns."""

    form: object

    @property
    def outputs(self):
        return 1

    @property
    def inputs(self):
        return 1

    def sample(self, key):
        sign = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        return jnp.diag(jnp.stack([sign, jnp.ones(())]))

    def moments(self, order):
        return self.form(np.diag([float((order - i) % 2 == 0) for i in range(order + 1)]))


def test_moments_may_be_a_matrix_and_of_another_shape_are_refused():
    check_random_affine(Turn(lambda matrix: matrix))
    check_random_affine(Turn(lambda matrix: matrix.tolist()))
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    for form, came in ((lambda m: m[:1], r"shape \(1, 3\)"), (lambda m: None, "None|not finite|shape")):
        with pytest.raises(ValueError, match=r"moments\(2\) of Turn: expected .*" + came):
            hg.linear_filter(plant, sensor, Turn(form))
    with pytest.raises(ValueError, match="Turn: expected a method mean_gain of its own"):
        hg.mean_gain_filter(plant, sensor, Turn(lambda matrix: matrix))


class Grid(hg.fusion.AbstractQuantizer):
    """Multiples of `width`."""

    width: float

    def init(self, n):
        return ()

    def step(self, state, value):
        value = jnp.asarray(value, dtype=float)
        error = jnp.where(jnp.isnan(value), jnp.nan, self.width / 2)
        rounded = self.width * jnp.round(value / self.width)
        return state, hg.fusion.Quantized(rounded, error, jnp.zeros(value.shape, bool), jnp.ones(value.shape, int))


@pytest.mark.parametrize("width", [0.1, 1 / 3, 1e-3, 0.5])
def test_a_quantizer_is_checked_in_double_precision(width):
    check_quantizer(Grid(width))


def test_a_quantizer_without_a_claim_of_its_own_leaves_nominal():
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    node = hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})
    network = hg.Network(plant, {"a": node}, {"c": hg.Fusion("k", hg.CovarianceIntersection(), Grid(0.5))})
    assert network.claims()["fused"] == {"c": "nominal"}
    assert np.isfinite(hg.simulate(network, 5, 0).estimates["fused"]["c"].mean).all()


def test_diffusion_is_no_rule_of_a_centre():
    one = hg.model.Estimate(np.zeros(1), np.eye(1), "exact")
    with pytest.raises(ValueError, match="fusion by DiffusionWeights: expected neighbours"):
        hg.fusion.fuse(hg.fusion.DiffusionWeights(), [one, one])


def test_neighbours_at_any_scale():
    """Those of integers, also in units of 1e-300 and 1e300, and for a radius that reaches all."""
    rng = np.random.default_rng(0)
    places = rng.integers(0, 20, size=(30, 2)).astype(float)
    expected = {
        str(i): tuple(str(j) for j in range(30) if j != i and np.hypot(*(places[i] - places[j])) <= 5)
        for i in range(30)
    }
    for unit in (1.0, 2.0**-990, 2.0**1010):
        positions = {str(i): place * unit for i, place in enumerate(places)}
        assert hg.fusion.neighbours_within(positions, 5.0 * unit) == expected
        every = hg.fusion.neighbours_within(positions, 1e308)
        assert all(len(near) == 29 for near in every.values())


@pytest.mark.parametrize("progress", [1, "x", np.zeros(2)])
def test_progress_is_reported_to_a_function(progress):
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {})})
    with pytest.raises(ValueError, match="progress: expected a function of"):
        hg.monte_carlo(network, 2, 2, 0, progress=progress)
    with pytest.raises(ValueError, match="progress: expected a function of"):
        hg.fit(lambda: network, {"a": np.zeros(3)}, progress=progress)
