"""Maps with modes: how they combine, what is drawn of them, and that the contract check sees their memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.memories_of_channels import memories
from heliograph.testing import check_random_affine

Autoregression, Faded, Modes, Series, Stack, joint_modes = (
    getattr(hg.random_affine, n) for n in ("Autoregression", "Faded", "Modes", "Series", "Stack", "joint_modes")
)
BURSTS = np.array([[0.8, 0.2], [0.1, 0.9]])
GOOD, BAD = hg.hop(hg.Discrete([0.9, 1.2], [0.5, 0.5]), 0.05), hg.hop(0.2, 0.3)
NOISY = hg.hop(hg.Rayleigh(0.5), hg.Gaussian([[0.1]], [0.2]))  # another kind of map than GOOD


def link(name=None, maps=(GOOD, BAD)):
    return Modes(hg.random_affine.MarkovChain(BURSTS, [0.3, 0.7], name), maps)


def drift(name=None, correlation=0.8):
    return hg.model.autoregressive_fading(1.0, 0.5, correlation, 0.1, name=name)


CHANNELS = {
    "a link": link(),
    "at rest": Modes(hg.random_affine.MarkovChain(BURSTS), [GOOD, BAD]),
    "maps of several kinds": link(maps=(NOISY, BAD)),
    "three modes": hg.markov_fading([0.1, 0.5, 1.0], [[0.6, 0.4, 0], [0.2, 0.5, 0.3], [0, 0.1, 0.9]], 0.1),
    "chains of their own": hg.amplify_and_forward([link(), link()]),
    "one chain": hg.amplify_and_forward([link("road"), NOISY, link("road")]),
    "a drift": drift(),
    "a drift and a chain": hg.model.with_direct_link(hg.amplify_and_forward([drift(), link()]), NOISY),
    "one drift twice": hg.amplify_and_forward([drift("hill"), drift("hill")]),
    "loss that is not observed": hg.dropout(hg.parallel([link(), drift()]), 0.6),
}

LARGE = {"chains of their own", "one chain", "a drift and a chain", "one drift twice", "loss that is not observed"}


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LARGE else n for n in CHANNELS])
def test_draws_have_the_moments_and_the_memory_that_they_state(name):
    check_random_affine(CHANNELS[name])


def test_the_square_of_a_link():
    check_random_affine(hg.random_affine.square(link()), highest=2)


class _Forgets(hg.random_affine.MarkovChain):
    """A chain that draws its initial law anew at each step: the second draw's law is right, its memory is not."""

    def move(self, state, key):
        return self.begin(key)


class _Stays(hg.random_affine.MarkovChain):
    def move(self, state, key):
        return state


@pytest.mark.parametrize("kind", [_Forgets, _Stays])
def test_the_check_finds_a_wrong_memory_whose_marginals_are_right(kind):
    """Of the chain whose memory is right, "at rest" above, it finds nothing."""
    with pytest.raises(AssertionError, match=r"^two draws in a row: a moment differs"):
        check_random_affine(Modes(kind(BURSTS), [GOOD, BAD]))


class _Splits(hg.random_affine.MarkovChain):
    """A chain that moves to either mode with probability 1/2: by the sign of noise, drawn with half of a key."""

    def move(self, state, key):
        return (GOOD.sample(jax.random.split(key)[0])[0, -1] > 0).astype(int)


def test_the_check_draws_twice_by_keys_that_have_no_part_in_common():
    """The second draw's map is drawn with half of its key: of another key than that by which the mode moved."""
    check_random_affine(Modes(_Splits(np.full((2, 2), 0.5)), [GOOD, BAD]))


def test_one_object_or_one_name_is_one_memory():
    chain = hg.random_affine.MarkovChain(BURSTS)
    local, same = Series([link(), link()]), Series([Modes(chain, [GOOD, BAD]), Modes(chain, [BAD, GOOD])])
    named = Series([link("road"), hg.gilbert_elliott(GOOD, BAD, 0.2, 0.1)])
    assert [len(memories(c)) for c in (local, same, named)] == [2, 1, 2]
    assert [len(joint_modes(c).maps) for c in (local, same, named)] == [4, 2, 4]
    with pytest.raises(ValueError, match=r"^memory 'road': expected one transition and one initial law, got several"):
        Series([link("road"), hg.gilbert_elliott(GOOD, BAD, 0.2, 0.1, name="road")]).init(jax.random.key(0))


def test_joint_modes_are_those_of_the_parts():
    """f(a, b) in mode (i, j) is f(a_i, b_j); block moments of a series are products."""
    a, b = link(), link(maps=(BAD, NOISY))
    joint = joint_modes(Series([a, b]))
    np.testing.assert_array_equal(joint.transition, np.kron(BURSTS, BURSTS))
    np.testing.assert_array_equal(joint.initial, np.kron([0.3, 0.7], [0.3, 0.7]))
    parts = [joint_modes(c).moments(2) for c in (a, b)]
    expected = [second @ first for first in parts[0] for second in parts[1]]
    np.testing.assert_allclose(joint.moments(2), expected, rtol=1e-14)


def test_a_map_that_forgets_has_one_mode():
    joint = joint_modes(GOOD)
    assert joint.maps == (GOOD,) and joint.transition.tolist() == [[1.0]] and joint.initial.tolist() == [1.0]


def test_a_users_map_needs_no_code_for_modes():
    class Doubled(hg.random_affine.AbstractRandomAffine):
        inside: hg.random_affine.AbstractRandomAffine
        outputs = inputs = 1

        def sample(self, key):
            return jnp.diag(jnp.array([2.0, 1.0])) @ self.inside.sample(key)

        def moments(self, order):
            return Series([self.inside, hg.random_affine.known([[2.0]])]).moments(order)

    check_random_affine(Doubled(hg.amplify_and_forward([link("road"), link("road")])))


@pytest.mark.parametrize("degree", [1, 2, 4])
def test_nodes_of_a_drift_reproduce_its_moments(degree):
    """E[c_1^i c_2^j] of two standard Gaussians of correlation rho, for i, j up to the degree."""
    rho = 0.7
    x, w, rows, _ = Autoregression(rho).nodes(degree)
    np.testing.assert_allclose(rows.sum(axis=1), 1, rtol=1e-13)
    nodes, weights = np.polynomial.hermite_e.hermegauss(12)
    weights = weights / weights.sum()
    later = rho * nodes[:, None] + np.sqrt(1 - rho**2) * nodes
    for i in range(degree + 1):
        for j in range(degree + 1):
            expected = np.einsum("a,b,a,ab->", weights, weights, nodes**i, later**j)
            assert (w * x**i) @ rows @ x**j == pytest.approx(expected, rel=1e-11, abs=1e-11)


@pytest.mark.parametrize("modes", [2, 3, 7])
def test_a_chain_for_a_drift_has_its_mean_variance_and_correlation(modes):
    x, w, rows, _ = Autoregression(-0.4).chain(modes)
    assert np.all(rows >= 0)
    np.testing.assert_allclose([w @ x, w @ x**2, (w * x) @ rows @ x], [0, 1, -0.4], atol=1e-14)
    np.testing.assert_allclose(rows @ x, -0.4 * x, atol=1e-14)
    np.testing.assert_allclose(w @ rows, w, atol=1e-15)


def test_two_modes_of_a_drift_are_a_chain():
    by_nodes, by_chain = (joint_modes(drift(), nodes) for nodes in (None, 2))
    np.testing.assert_allclose(by_nodes.transition, by_chain.transition, rtol=1e-14)
    assert by_nodes.transition[0, 1] == pytest.approx((1 - 0.8) / 2, rel=1e-14)


BAD_INPUT = {
    "rows": (
        lambda: hg.random_affine.MarkovChain([[0.5, 0.4], [0, 1]]),
        "transition from mode 0: expected probabilities",
    ),
    "shape": (lambda: hg.random_affine.MarkovChain([[0.5, 0.5]]), "transition matrix: expected a square matrix"),
    "several stationary laws": (lambda: hg.random_affine.MarkovChain(np.eye(2)), "initial law: expected one"),
    "initial law": (lambda: hg.random_affine.MarkovChain(BURSTS, [0.5, 0.6]), "initial law: expected probabilities"),
    "name": (lambda: hg.random_affine.MarkovChain(BURSTS, name=3), "name of a memory: expected a text"),
    "radius": (lambda: hg.random_affine.MarkovChain(BURSTS, radius=1.2), "radius of the transition: expected"),
    "maps": (lambda: link(maps=(GOOD,)), "maps of the modes: expected 2"),
    "shapes": (lambda: link(maps=(GOOD, hg.hop(1.0, 0.1, dimension=2))), "maps of the modes: expected maps of one"),
    "memory inside": (lambda: link(maps=(GOOD, link())), "map of a mode: expected one that forgets"),
    "gains without noise": (lambda: hg.markov_fading([0.2, 1.0], BURSTS), "noise: expected one"),
    "noise beside channels": (lambda: hg.markov_fading([GOOD, BAD], BURSTS, 0.1), "noise: expected none"),
    "a chain's name": (
        lambda: hg.markov_fading([GOOD, BAD], hg.random_affine.MarkovChain(BURSTS), name="x"), "name: expected none"
    ),
    "fail": (lambda: hg.gilbert_elliott(GOOD, BAD, 1.2, 0.1), "fail: expected a number from 0 to 1"),
    "neither fails nor recovers": (lambda: hg.gilbert_elliott(GOOD, BAD, 0.0, 0.0), "initial law: expected one"),
    "correlation": (lambda: drift(correlation=1.1), "correlation from step to step: expected a number from -1 to 1"),
    "too many": (lambda: joint_modes(Series([link() for _ in range(11)])), "memories of a channel: expected at most"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input_gets_one_clear_line(name):
    make, words = BAD_INPUT[name]
    with pytest.raises(ValueError, match=f"^{words}") as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_sum_of_links_with_memory_is_in_their_joint_modes():
    """A burst of losses, a fading that drifts and one chain that two links share: draws against moments over time."""
    burst = hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.model.silent(1, 1, 0.1), 0.2, 0.4)
    drifts = hg.model.autoregressive_fading(1.0, 0.3, 0.9, 0.1)
    channel = hg.superposed([burst, drifts, hg.hop(hg.Rayleigh(0.5), 0.0)], 0.05)
    assert len(hg.random_affine.joint_modes(channel).maps) == 2 * 2
    check_random_affine(channel, highest=2)
    common = hg.markov_fading([0.5, 1.5], [[0.8, 0.2], [0.3, 0.7]], 0.1, name="fog")
    twice = hg.superposed([common, common], 0.05)
    assert len(hg.random_affine.joint_modes(twice).maps) == 2
    check_random_affine(twice, highest=2)
