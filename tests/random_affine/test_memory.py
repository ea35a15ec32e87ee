"""A map that remembers keeps its state through every map made of maps, or is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments import push_moments
from heliograph.testing import check_random_affine

GAINS = np.array([0.2, 1.0])
NEXT = np.array([[0.95, 0.05], [0.1, 0.9]])  # P(next j | now i)
STATIONARY = np.array([2 / 3, 1 / 3])
PAIRS = 40_000


def lagged(power: int = 1) -> float:
    """E[g_k^power g_(k+1)^power] of the chain."""
    return float((STATIONARY * GAINS**power) @ NEXT @ GAINS**power)


class Switching(AbstractRandomAffine):
    """z = g y, where g moves between two values as a Markov chain does."""

    @property
    def outputs(self):
        return 1

    @property
    def inputs(self):
        return 1

    @property
    def remembers(self):
        return True

    def init(self, key):
        return jax.random.bernoulli(key, STATIONARY[1]).astype(int)

    def draw(self, state, key):
        following = jax.random.bernoulli(key, jnp.asarray(NEXT)[state, 1]).astype(int)
        return following, jnp.diag(jnp.stack([jnp.asarray(GAINS)[state], 1.0]))


class Forgetful(AbstractRandomAffine):
    """A user's map around another that passes no state on."""

    inside: list[AbstractRandomAffine]

    @property
    def outputs(self):
        return 1

    @property
    def inputs(self):
        return 1

    def sample(self, key):
        return 2 * self.inside[0].sample(key)


class HalfThreaded(Forgetful):
    """It draws with the state, but does not start it."""

    def draw(self, state, key):
        return self.inside[0].draw(state, key)


HOP = hg.hop(hg.Discrete([0.5, 1.5], [0.5, 0.5]), 0.1)  # E g = 1
MEAN = float(STATIONARY @ GAINS)
COMBINED = {  # channel, entry of H, E[entry_k entry_(k+1)]
    "itself": (Switching(), (0, 0), lagged()),
    "series": (hg.random_affine.Series([HOP, Switching()]), (0, 0), lagged()),
    "series of two chains": (hg.random_affine.Series([Switching(), Switching()]), (0, 0), lagged() ** 2),
    "stack": (hg.random_affine.Stack([HOP, Switching()]), (1, 0), lagged()),
    "mixture": (hg.random_affine.Mixture([hg.model.silent(), Switching()], [0.2, 0.8]), (0, 0), 0.64 * lagged()),
    "dropout": (hg.dropout(hg.random_affine.Series([Switching(), HOP]), 0.8), (0, 0), 0.64 * lagged()),
    "erasure": (hg.erasure(Switching(), 0.8), (0, 0), lagged()),
    "lift": (hg.random_affine.square(Switching()), (0, 0), lagged(2)),
    "parallel": (hg.parallel([HOP, Switching()]), (1, 1), lagged()),
    "all of them": (
        hg.erasure(
            hg.random_affine.Stack([hg.dropout(hg.random_affine.Series([HOP, Switching()]), 0.5), Switching()]), 0.9
        ),
        (0, 0), 0.25 * lagged(),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", COMBINED)
def test_the_state_survives(name):
    """Over two steps the product of gains has its exact mean, which draws without a state would miss."""
    channel, entry, expected = COMBINED[name]
    assert channel.remembers

    def pair(key):
        start, item, two = jax.random.split(key, 3)
        state, first = channel.draw(channel.init(start), item)
        return first[entry] * channel.draw(state, two)[1][entry]

    with jax.enable_x64(True):
        products = np.asarray(jax.jit(jax.vmap(pair))(jax.random.split(jax.random.key(1), PAIRS)))
    received = products[~np.isnan(products)]
    error = received.std() / np.sqrt(len(received))
    assert abs(received.mean() - expected) < 4 * error
    if name in ("itself", "series", "stack", "erasure", "parallel"):
        assert abs(received.mean() - MEAN**2) > 20 * error  # what independent draws would give


@pytest.mark.parametrize("name", ["itself", "lift", "all of them"])
def test_the_contract_holds(name):
    check_random_affine(COMBINED[name][0])


@pytest.mark.slow
def test_a_map_that_forgets_has_no_state_and_draws_what_it_samples():
    channel = hg.dropout(
        hg.random_affine.Stack([HOP, hg.random_affine.Series([HOP, hg.hop(hg.Rayleigh(1.0), 0.2)])]), 0.7
    )
    key = jax.random.key(3)
    assert not channel.remembers and channel.init(key) == ()
    state, drawn = channel.draw((), key)
    assert state == ()
    np.testing.assert_array_equal(drawn, channel.sample(key))


@pytest.mark.parametrize(
    ("lose", "name"),
    [
        (lambda key: Forgetful([Switching()]).init(key), "init of Forgetful"),
        (lambda key: Forgetful([Switching()]).draw((), key), "draw of Forgetful"),
        (lambda key: Forgetful([Switching()]).sample(key), "sample of Switching"),
        (lambda key: HalfThreaded([Switching()]).init(key), "init of HalfThreaded"),
        (
            lambda key: hg.random_affine.Series([HOP, Forgetful([hg.random_affine.Series([Switching()])])]).init(key),
            "init of Forgetful",
        ),
        (lambda key: hg.random_affine.Series([HOP, Switching()]).sample(key), "sample of Series"),
        (lambda key: check_random_affine(Forgetful([Switching()])), "init of Forgetful"),
    ],
)
def test_a_state_that_would_be_lost_is_refused(lose, name):
    with pytest.raises(ValueError, match=f"^{name}: expected ") as caught:
        lose(jax.random.key(0))
    assert "\n" not in str(caught.value)


PLANT = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]])
SENSOR = hg.LinearSensor([[1.0]], 0.1)


@pytest.mark.parametrize(
    "channel",
    [
        Switching(),
        hg.erasure(hg.random_affine.Series([HOP, Switching()]), 0.5),
        hg.random_affine.Stack([HOP, Switching()]),
        hg.dropout(Switching(), 0.5),
    ],
)
@pytest.mark.parametrize(
    "use",
    [
        lambda c: c.moments(2),
        lambda c: push_moments(c, 2, np.ones(3)),
        lambda c: c.moment_interval(2),
        hg.random_affine.second_order,
        lambda c: c.disturb_gain(),
        hg.model.mean_gain,
        lambda c: hg.linear_filter(PLANT, SENSOR, c),
        lambda c: hg.cubature_filter(PLANT, SENSOR, c),
        lambda c: hg.mean_gain_filter(PLANT, SENSOR, c),
        lambda c: hg.filters.mixture_filter(PLANT, SENSOR, c),
    ],
)
def test_what_knows_only_independent_draws_refuses_a_memory(use, channel):
    with pytest.raises(ValueError, match=r": expected .*, got ") as caught:
        use(channel)
    assert "\n" not in str(caught.value)


def test_a_map_without_a_draw_says_so():
    class Nothing(AbstractRandomAffine):
        pass

    with pytest.raises(ValueError, match="Nothing: expected a method sample of its own"):
        Nothing().sample(jax.random.key(0))
    assert eqx.tree_equal(Nothing(), Nothing())
