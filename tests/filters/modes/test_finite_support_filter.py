"""The filter that knows the laws: where it is exact, and where it must refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import heliograph as hg
from tests.follow import follow
from tests.oracles import quadratic_bias as oracle
from tests.relay_bias import model

TWO = hg.random_affine.FiniteSupport([[2.0], [-0.5]], [0.2, 0.8])


def one_step(plant, sensor, channel, z, **options):
    item = hg.filters.mixture_filter(plant, sensor, channel, **options)
    return item.step(item.init(), np.atleast_1d(z))[1]


def test_gaussian_laws_give_the_linear_filter():
    plant = hg.LinearPlant([[0.9, 0.2], [0.0, 0.7]], 0.3, [1.0, 0.0], np.eye(2))
    sensor, channel = hg.LinearSensor([[1.0, 0.5]], 0.2), hg.hop(0.8, 0.1)
    mixed, linear = hg.filters.mixture_filter(plant, sensor, channel), hg.linear_filter(plant, sensor, channel)
    a, b = mixed.init(), linear.init()
    for k, z in enumerate((0.3, -1.0, 2.0)):
        a, left = mixed.step(a, [z], (), k)
        b, right = linear.step(b, [z], (), k)
        np.testing.assert_allclose(left.mean, right.mean, rtol=1e-12)
        np.testing.assert_allclose(left.covariance, right.covariance, rtol=1e-12)


def test_first_step_is_bayes_rule_on_a_grid():
    """Gaussian prior, gain and noise of two values each: posterior mean and variance by quadrature."""
    plant = hg.LinearPlant([[1.0]], 0.5, [0.3], 0.5)
    gain, noise = hg.Discrete([0.5, 1.5], [0.4, 0.6]), hg.Gaussian([[0.2]])
    channel, sensor = hg.hop(gain, noise), hg.LinearSensor([[1.0]], TWO)
    x = np.linspace(-12, 12, 200_001)
    z = 0.7
    density = stats.norm.pdf(x, 0.3, 1.0) * sum(
        p * q * stats.norm.pdf(z, g * (x + v), np.sqrt(0.2))
        for p, g in zip(gain.probabilities, gain.values, strict=True)
        for q, v in zip(TWO.probabilities, TWO.atoms[:, 0], strict=True)
    )
    density /= density.sum()
    mean = density @ x
    result = one_step(plant, sensor, channel, z)
    assert result.mean[0] == pytest.approx(mean, rel=1e-9)
    assert result.covariance[0, 0] == pytest.approx(density @ (x - mean) ** 2, rel=1e-9)


def test_atoms_have_the_channels_moments():
    s = model(oracle.paper_example(), 1)
    stacked = hg.random_affine.Stack([s.channel, hg.dropout(hg.hop(0.9, TWO), 0.7)])
    atoms = stacked.list_atoms()
    assert sum(a.weight for a in atoms) == pytest.approx(1.0, abs=1e-14)
    x = np.array([0.8])
    z = np.array([a.gain @ x + a.offset for a in atoms])
    mean = np.array([a.weight for a in atoms]) @ z
    np.testing.assert_allclose(mean, (stacked.moments(1).matrix @ [0.8, 1.0])[:2], rtol=1e-12)
    assert len(s.channel.list_atoms()) == 36  # 3 powers x 2 atoms at each of two hops; the sensor's noise doubles it


def test_a_missing_measurement_is_a_prediction():
    plant = hg.LinearPlant([[0.5]], 1.0, [2.0], 3.0)
    result = one_step(plant, hg.LinearSensor([[1.0]], TWO), hg.perfect(), np.nan)
    assert result.mean[0] == pytest.approx(1.0) and result.covariance[0, 0] == pytest.approx(0.25 * 3 + 1.0)


def test_on_the_example_it_is_far_better_than_any_polynomial():
    s = model(oracle.paper_example(), 30, initial=0.01 * np.eye(2))
    cubic = hg.linear.lmmse(hg.linear.lifted_system(*s, 3, 30)).gains.covariance[15:, 0, 0].mean()
    network = hg.Network(s.plant, {"node": hg.Node(s.sensor, s.channel, {"mixture": hg.filters.mixture_filter(*s)})})
    result = hg.monte_carlo(network, 30, 96, 0, keep=hg.Statistics())["node"]["mixture"]
    assert result.actual()[15:, 0, 0].mean() < 0.35 * cubic  # 0.0079 against 0.033


def test_a_combination_without_randomness_is_believed_where_z_agrees_with_it_and_only_there():
    """A link that is off says 0 or 1 by its own noise: a point mass, against which a density is nothing."""
    plant, sensor = hg.LinearPlant([[0.5]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], TWO)
    channel = hg.hop(hg.random_affine.bernoulli(0.5), hg.random_affine.FiniteSupport([[0.0], [1.0]], [0.5, 0.5]))
    off = one_step(plant, sensor, channel, 1.0)
    np.testing.assert_allclose([off.mean[0], off.covariance[0, 0]], [0.0, 1.25], rtol=1e-14)
    on = one_step(plant, sensor, channel, 0.75)
    assert on.covariance[0, 0] < 1.0 and abs(on.mean[0]) > 0.1


def test_what_has_no_atoms_is_refused():
    plant, sensor = hg.LinearPlant([[0.5]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], TWO)
    with pytest.raises(ValueError, match="gains of finitely many values, got Rayleigh"):
        hg.filters.mixture_filter(plant, sensor, hg.hop(hg.Rayleigh(1.0), 0.1))
    count = hg.random_affine.FiniteSupport(np.arange(100.0)[:, None], np.full(100, 0.01))
    with pytest.raises(ValueError, match="at most 4,096 combinations of atoms, got 10,000"):
        hg.filters.mixture_filter(plant, sensor, hg.amplify_and_forward([hg.hop(1.0, count), hg.hop(1.0, count)]))
    moments = hg.random_affine.NoiseMoments([0.0, 1.0, 0.5, 2.0])
    with pytest.raises(ValueError, match="finite support or Gaussian, got NoiseMoments"):
        hg.filters.mixture_filter(plant, hg.LinearSensor([[1.0]], moments), hg.perfect())


CHAIN = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
PLANT, SENSOR = hg.LinearPlant([[0.9]], 0.5, [0.3], 0.5), hg.LinearSensor([[1.0]], TWO)
MODES = [hg.hop(hg.Discrete([0.5, 1.5], [0.4, 0.6]), 0.2), hg.hop(-0.3, 0.1)]


def run(item, data):
    """Mean and variance after each measurement."""
    steps = follow(item, data)
    return np.column_stack([steps.mean[:, 0], steps.covariance[:, 0, 0]])


def test_modes_are_weighed_with_their_atoms():
    """Two steps: the modes' probabilities after each are Bayes' rule on the filter's own Gaussian."""
    item = hg.filters.mixture_filter(PLANT, SENSOR, hg.markov_fading(MODES, CHAIN))
    law, state = np.array([0.75, 0.25]), item.init()
    for k, z in enumerate((0.7, -1.1)):
        moved = item.predict(state, (), k)
        law = law if k == 0 else law @ CHAIN.transition
        np.testing.assert_allclose(moved.law, law, rtol=1e-12)
        x = moved.gaussian
        p = x.covariance[0, 0]
        likelihood = np.zeros(2)
        for i, m in enumerate(MODES):
            for c in hg.random_affine.Series([hg.hop(1.0, TWO), m]).list_atoms():
                g = c.gain[0, 0]
                density = stats.norm.pdf(z, g * x.mean[0] + c.offset[0], np.sqrt(g * p * g + c.noise[0, 0]))
                likelihood[i] += c.weight * density
        state, innovation = item.correct(moved, [z], k)
        np.testing.assert_allclose(innovation.log_likelihood, np.log(law @ likelihood), rtol=1e-12)
        law = law * likelihood / (law @ likelihood)
        np.testing.assert_allclose(state.law, law, rtol=1e-12)


def test_a_chain_that_forgets_is_a_mixture():
    """Equal rows: the same numbers as one map chosen anew at each step."""
    law = [0.75, 0.25]
    data = (0.7, np.nan, -1.1, 2.0)
    chained = run(hg.filters.mixture_filter(PLANT, SENSOR, hg.markov_fading(MODES, [law, law])), data)
    mixed = run(hg.filters.mixture_filter(PLANT, SENSOR, hg.random_affine.Mixture(MODES, law)), data)
    np.testing.assert_allclose(chained, mixed, rtol=1e-12)


def test_one_mode_is_the_filter_without_modes():
    data = (0.7, -1.1, 2.0)
    record = run(hg.filters.mixture_filter(PLANT, SENSOR, hg.markov_fading(MODES[:1], [[1.0]])), data)
    plain = run(hg.filters.mixture_filter(PLANT, SENSOR, MODES[0]), data)
    np.testing.assert_array_equal(record, plain)


def test_with_gaussian_noise_it_is_gpb1():
    sensor, links = hg.LinearSensor([[1.0]], 0.1), hg.markov_fading([0.2, 1.0], CHAIN, noise=0.05)
    data = (0.7, -1.1, 2.0, 0.1)
    mixture = run(hg.filters.mixture_filter(PLANT, sensor, links), data)
    merged = run(hg.filters.gpb1_filter(PLANT, sensor, links), data)
    np.testing.assert_allclose(mixture, merged, rtol=1e-12)


def test_a_drift_has_no_atoms():
    with pytest.raises(ValueError, match="gains of finitely many values, got one that drifts"):
        hg.filters.mixture_filter(PLANT, SENSOR, hg.model.autoregressive_fading(1.0, 0.3, 0.9, 0.1))


@pytest.mark.parametrize("channel", [hg.dropout(hg.perfect(), 0.0), hg.model.silent(noise=0), hg.hop(0.0, 0.0)])
def test_a_value_that_no_combination_leaves_says_nothing(channel):
    """It was NaN for ever; the likelihood is none, and the next value is used as if it had not been."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    item = hg.filters.mixture_filter(plant, sensor, channel)
    prior = item.predict(item.init())
    after, innovation = item.correct(prior, [0.5])
    np.testing.assert_array_equal(item.estimate(after).mean, item.estimate(prior).mean)
    np.testing.assert_array_equal(item.estimate(after).covariance, item.estimate(prior).covariance)
    assert innovation.log_likelihood == -np.inf
    stream = hg.Stream(item)
    with pytest.raises(
        ValueError, match=r"measurement of step 0: expected a plausible one, got \[0.5\]: a value that the"
    ):
        stream.push([0.5])
    assert stream.push([0.0]).mean == 0.0 and stream.steps == 1


def test_derivatives_by_what_the_law_is_made_of():
    """Gains, their probabilities and the noise of a link, traced: slopes of central differences.

    These are off by h^2 of third derivatives and by rounding / h: some 1e-9 of numbers of size 1 at h = 1e-4.
    """
    plant, sensor = hg.LinearPlant([[0.9]], 0.3, [0.3], 0.5), hg.LinearSensor([[1.0], [1.0]], 0.2)

    @jax.jit
    def log_likelihood(p):
        law = hg.Discrete(jnp.stack([p[0], 0.2]), jnp.stack([p[1], 1.0 - p[1]]))
        lossy = hg.parallel([hg.hop(law, jnp.reshape(p[2], (1, 1))), hg.dropout(hg.hop(1.0, p[2]), p[1])])
        item = hg.filters.mixture_filter(plant, sensor, lossy)
        return item.correct(item.predict(item.init()), np.array([0.4, -0.2]))[1].log_likelihood

    with jax.enable_x64(True):
        at, h = np.array([1.3, 0.4, 0.25]), 1e-4
        slopes = jax.jit(jax.jacfwd(log_likelihood))(jnp.array(at))
        expected = [(log_likelihood(at + e) - log_likelihood(at - e)) / (2 * h) for e in h * np.eye(3)]
    np.testing.assert_allclose(slopes, expected, rtol=1e-6)
