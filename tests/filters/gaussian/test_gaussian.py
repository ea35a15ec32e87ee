import jax
import numpy as np
import pytest
from filterpy.kalman import CubatureKalmanFilter, KalmanFilter

import heliograph as hg
import tests.follow
from heliograph.testing import check_filter
from tests import machine
from tests.machine import PRINTED, STRONG
from tests.oracles import cubature_fusion as oracle

STEPS = 6
ROUNDING = 1e-10  # relative to the largest entry: six steps of 5x5 arithmetic, each rounded to 1e-16
SCALARS = {"printed": (1e-6, 1e-4), "strong": (1e-3, 1e-2)}
SETTINGS = {"printed": PRINTED, "strong": STRONG}


def follow(item, measurements):
    """Means and covariances of a filter over (steps, m) measurements."""
    return tests.follow.follow(item, measurements)[:2]


def follow_oracle(setting, node, predict, update, measurements):
    x, bound, means, bounds = setting["xhat0"][node], setting["Xi0"], [], []
    for z in measurements:
        x, bound = update(*predict(x, bound, setting), setting["C"][node], z, setting)
        means.append(x)
        bounds.append(bound)
    return np.array(means), np.array(bounds)


def agree(ours, theirs, tolerance=ROUNDING):
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max())


def cases():
    poly = oracle.poly_terms
    for name in SETTINGS:
        s, fixed = SETTINGS[name], hg.filters.Scalars(*SCALARS[name])
        yield (
            name,
            "cubature, fixed",
            hg.cubature_filter,
            hg.filters.Polytope(fixed),
            oracle.predict_cubature,
            oracle.bounded(poly(s), False),
        )
        yield (
            name,
            "cubature, optimal",
            hg.cubature_filter,
            hg.filters.Polytope(),
            oracle.predict_cubature,
            oracle.bounded(poly(s), True),
        )
        yield (
            name,
            "extended, fixed",
            hg.extended_filter,
            hg.filters.Polytope(fixed),
            oracle.predict_extended,
            oracle.bounded(poly(s), False),
        )
        yield (
            name,
            "zero mean",
            hg.cubature_filter,
            hg.filters.ZeroMean(),
            oracle.predict_cubature,
            oracle.orthogonal(poly(s)),
        )


@pytest.mark.parametrize("case", list(cases()), ids=lambda c: f"{c[0]}, {c[1]}")
def test_bounded_filters_are_the_oracles_recursion(case):
    name, _, build, update, predict, reference = case
    s, node = SETTINGS[name], 1
    z = machine.data(s, STEPS)[:, node]
    item = build(machine.plant(s), machine.sensor(s, node), machine.channel(s), update, **machine.start(s, node))
    # Scalars that are optimised stop at different points of a flat minimum: the trace agrees to second order.
    agree(follow(item, z), follow_oracle(s, node, predict, reference, z), 1e-8 if "fixed" not in case[1] else ROUNDING)


def test_mean_gain_filter_is_the_textbook_filter_at_the_mean_gain():
    z = machine.data(STRONG, STEPS)[:, 0]
    item = hg.mean_gain_filter(machine.plant(STRONG), machine.sensor(STRONG, 0), machine.channel(STRONG))
    agree(follow(item, z), follow_oracle(STRONG, 0, oracle.predict_cubature, oracle.naive, z))
    assert item.claim == "nominal"


def perfect_relay(qm=0.0, qn=0.0):
    return hg.amplify_and_forward([hg.hop(1.0, qm, dimension=2), hg.hop(1.0, qn, dimension=2)])


@pytest.mark.parametrize(("qm", "qn"), [(0.0, 0.0), (2e-3, 1e-3)])
def test_a_perfect_channel_gives_the_textbook_filter_with_the_noises_added(qm, qn):
    """Exact limit: xi = gamma = 1, no uncertainty, alpha sqrt(E) = 1."""
    z = machine.data(STRONG, STEPS)[:, 2]
    noisier = {**STRONG, "Q": STRONG["Q"] + (qm + qn) * np.eye(2), "Qm": 0 * np.eye(2), "Qn": 0 * np.eye(2)}
    for update in (hg.filters.Polytope(), hg.filters.ZeroMean()):
        item = hg.cubature_filter(machine.plant(STRONG), machine.sensor(STRONG, 2), perfect_relay(qm, qn), update)
        unit = {**noisier, "alpha": 1.0}
        reference = follow_oracle(unit, 2, oracle.predict_cubature, oracle.known_gains(np.ones(()), np.ones(())), z)
        agree(follow(item, z), reference)


def test_filterpy_agrees_where_it_is_right():
    """FilterPy's cubature filter does not redraw its points, so it is right for R = 0 only (and there it agrees)."""
    s = {**STRONG, "R": np.zeros((5, 5))}
    move, sense = machine.transition(s), s["C"][0]
    peer = CubatureKalmanFilter(5, 2, 1.0, lambda x: sense @ x, lambda x, dt: np.asarray(move(x, ())))
    peer.x, peer.P, peer.Q, peer.R = s["xbar0"][:, None].copy(), s["P0"].copy(), s["R"], s["Q"]
    z = machine.data(s, STEPS)[:, 0]
    item = hg.cubature_filter(machine.plant(s), machine.sensor(s, 0), hg.perfect(2))
    means = []
    with jax.enable_x64(True):
        for row in z:
            peer.predict()
            peer.update(row[:, None])
            means.append(peer.x.ravel().copy())
    agree([follow(item, z)[0]], [np.array(means)])


def test_scaling_signal_gain_and_noise_together_changes_nothing():
    """(alpha, ybar, sqrt Qn) t and (El, Qm) t^2, Er / t^2 leave the filter as it is."""
    z = machine.data(STRONG, STEPS)[:, 0]
    ours = [machine.plant(STRONG), machine.sensor(STRONG, 0)]
    first = follow(hg.cubature_filter(*ours, machine.channel(STRONG)), z)
    louder = {**STRONG, "alpha": 3 * STRONG["alpha"], "Qn": 9 * STRONG["Qn"]}
    agree(follow(hg.cubature_filter(*ours, machine.channel(louder)), 3 * z), first)
    traded = {**STRONG, "El": 4 * STRONG["El"], "Qm": 4 * STRONG["Qm"], "Er": STRONG["Er"] / 4}
    agree(follow(hg.cubature_filter(*ours, machine.channel(traded)), z), first)


def test_a_silent_amplifier_leaves_the_inflated_prediction():
    """alpha = 0: K = 0 and Xi = (1 + beta_1) P-, to rounding of variances of .02."""
    off = {**STRONG, "alpha": 0.0}
    z = machine.data(STRONG, STEPS)[:, 0]
    scalars = hg.filters.Scalars(1e-3, 1e-2)
    item = hg.cubature_filter(
        machine.plant(STRONG), machine.sensor(STRONG, 0), machine.channel(off), hg.filters.Polytope(scalars)
    )
    state = item.init()
    for row in z:
        prior = item.predict(state)
        state, estimate = item.step(state, row)
        np.testing.assert_allclose(estimate.covariance, (1 + 1e-3) * prior.covariance, rtol=1e-12, atol=1e-17)
        np.testing.assert_allclose(estimate.mean, prior.mean, rtol=0, atol=0)


def test_known_laws_make_all_updates_equal():
    """rho = kappa = 0: tight = polytope = zero mean."""
    z = machine.data(STRONG, STEPS)[:, 0]
    parts = (machine.plant(STRONG), machine.sensor(STRONG, 0), machine.channel(STRONG, radius=0.0))
    agree(
        follow(hg.cubature_filter(*parts, hg.filters.Polytope()), z),
        follow(hg.cubature_filter(*parts, hg.filters.ZeroMean()), z),
    )


LINEAR = hg.LinearPlant([[0.9, 0.2], [-0.1, 0.8]], 0.1, [1.0, -1.0], 0.5)
SENSOR = hg.LinearSensor([[1.0, 0.5], [0.0, 1.0]], 0.2)


def test_linear_plant_and_known_gain_give_the_kalman_filter_exactly():
    gain, noise = 1.3, 0.05
    z = np.random.default_rng(0).normal(size=(STEPS, 2))
    peer = KalmanFilter(2, 2)
    peer.x, peer.P = LINEAR.initial_mean.copy(), LINEAR.initial_covariance.copy()
    peer.F, peer.Q = LINEAR.matrix, 0.1 * np.eye(2)
    peer.H, peer.R = gain * SENSOR.matrix, (gain**2 * 0.2 + noise) * np.eye(2)
    means, bounds = [], []
    for row in z:
        peer.predict()
        peer.update(row)
        means.append(np.ravel(peer.x))
        bounds.append(peer.P.copy())
    for build in (hg.cubature_filter, hg.extended_filter, hg.linear_filter):
        item = build(LINEAR, SENSOR, hg.hop(gain, noise, dimension=2))
        assert item.claim == "exact"
        agree(follow(item, z), (np.array(means), np.array(bounds)))


def test_claims_name_what_is_true():
    known, fading = hg.hop(1.0, 0.1, dimension=2), hg.hop(hg.Rayleigh(1.0), 0.1, dimension=2)
    uncertain = hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5], 0.1), 0.1, dimension=2)
    assert hg.cubature_filter(LINEAR, SENSOR, fading).claim == "nominal"  # E[yy'] is read off the estimate
    assert hg.linear_filter(LINEAR, SENSOR, fading).claim == "exact"
    assert hg.linear_filter(LINEAR, SENSOR, uncertain).claim == "upper"
    assert hg.mean_gain_filter(LINEAR, SENSOR, known).claim == "nominal"
    assert hg.filters.open_loop_filter(LINEAR).claim == "exact"
    assert hg.filters.open_loop_filter(machine.plant(STRONG)).claim == "nominal"
    assert hg.cubature_filter(machine.plant(STRONG), machine.sensor(STRONG, 0), hg.perfect(2)).claim == "nominal"


FILTERS = {
    "cubature": lambda c: hg.cubature_filter(LINEAR, SENSOR, c),
    "extended": lambda c: hg.extended_filter(LINEAR, SENSOR, c),
    "zero mean": lambda c: hg.cubature_filter(LINEAR, SENSOR, c, hg.filters.ZeroMean()),
    "linear": lambda c: hg.linear_filter(LINEAR, SENSOR, c),
}
PARALLEL = hg.parallel([hg.hop(hg.Rayleigh(1.0), 0.1), hg.hop(hg.random_affine.Nakagami(2.0), 0.2)])


@pytest.mark.parametrize("name", FILTERS)
def test_contract(name):
    check_filter(FILTERS[name](PARALLEL))


@pytest.mark.parametrize("name", FILTERS)
def test_a_missing_component_equals_a_channel_that_is_off(name):
    """Deleting a row of z and switching its channel off are the same thing."""
    off = hg.parallel([hg.hop(hg.Rayleigh(1.0), 0.1), hg.model.silent(1, 1, 7.0)])
    z = np.random.default_rng(1).normal(size=(STEPS, 2))
    missing = z.copy()
    missing[:, 1] = np.nan
    agree(follow(FILTERS[name](PARALLEL), missing), follow(FILTERS[name](off), z))


def test_nothing_received_is_open_loop():
    z = np.full((STEPS, 2), np.nan)
    agree(follow(FILTERS["cubature"](PARALLEL), z), follow(hg.filters.open_loop_filter(LINEAR), z))


def test_a_component_known_exactly_is_no_error():
    plant = hg.LinearPlant(np.eye(2), np.diag([0.1, 0.0]), [0.0, 3.0], np.diag([1.0, 0.0]))
    mean, bound = follow(hg.cubature_filter(plant, SENSOR, hg.perfect(2)), np.zeros((3, 2)))
    assert np.all(np.isfinite(mean)) and np.allclose(mean[:, 1], 3.0) and np.allclose(bound[:, 1], 0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hg.cubature_filter(LINEAR, SENSOR, hg.perfect(3)), "sensor's 2 outputs, .* got one that takes 3"),
        (
            lambda: hg.cubature_filter(LINEAR, hg.LinearSensor([[1.0]], 1.0), hg.perfect(1)),
            "measure a state of length 2",
        ),
        (lambda: hg.linear_filter(machine.plant(STRONG), SENSOR, PARALLEL), "LinearPlant and a LinearSensor"),
        (
            lambda: hg.cubature_filter(LINEAR, SENSOR, PARALLEL, initial_mean=[1.0]),
            r"initial mean: expected shape \(2\)",
        ),
        (lambda: hg.filters.Scalars(0.0, 1.0), "two positive numbers"),
        (lambda: hg.filters.ZeroMean(-1.0), "a positive number"),
    ],
)
def test_parts_that_do_not_fit_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_constant_gain_is_a_scaled_signal():
    z = machine.data(STRONG, STEPS)[:, 0]
    gains = hg.amplify_and_forward([hg.hop(0.7, 2e-3, dimension=2), hg.hop(1.5, 1e-3, dimension=2)])
    scaled = hg.LinearSensor(
        0.7 * 1.5 * STRONG["C"][0], (0.7 * 1.5) ** 2 * STRONG["Q"] + (1.5**2 * 2e-3 + 1e-3) * np.eye(2)
    )
    ours = hg.cubature_filter(machine.plant(STRONG), machine.sensor(STRONG, 0), gains)
    agree(follow(ours, z), follow(hg.cubature_filter(machine.plant(STRONG), scaled, hg.perfect(2)), z))


def test_known_laws_make_the_interval_bound_the_polytope():
    """rho = kappa = 0: tight = polytope."""
    z = machine.data(STRONG, STEPS)[:, 0]
    parts = (machine.plant(STRONG), machine.sensor(STRONG, 0), machine.channel(STRONG, radius=0.0))
    agree(
        follow(hg.cubature_filter(*parts, hg.filters.Interval()), z),
        follow(hg.cubature_filter(*parts, hg.filters.Polytope()), z),
    )


def test_every_transform_is_the_same_for_linear_plants():
    z = np.random.default_rng(2).normal(size=(STEPS, 2))
    parts = (LINEAR, SENSOR, PARALLEL)
    rules = [hg.filters.Cubature(), hg.filters.Linearization(), hg.filters.PolynomialMoments(1)]
    first, *others = (follow(hg.filters.gaussian_filter(*parts, rule), z) for rule in rules)
    for other in others:
        agree(other, first)


@pytest.mark.parametrize(
    "local", [{"initial_mean": [0.0]}, {"initial_covariance": [[1e-4]]}], ids=lambda o: next(iter(o))
)
def test_a_filter_with_an_initial_law_of_its_own_is_not_exact(local):
    plant, sensor = hg.LinearPlant([[0.95]], 0.01, [0.0], 1.0), hg.LinearSensor([[1.0]], 1.0)
    filters = {
        "cubature": hg.cubature_filter(plant, sensor, hg.perfect(), **local),
        "kalman": hg.kalman_filter(plant, sensor, **local),
        "open": hg.filters.open_loop_filter(plant, **local),
    }
    central = hg.filters.sequential_filter([filters["kalman"], hg.kalman_filter(plant, sensor)])
    ahead = hg.filters.prediction_of(filters["cubature"])
    assert {item.claim for item in (*filters.values(), central, ahead)} == {"nominal"}
    assert hg.kalman_filter(plant, sensor).claim == "exact"
