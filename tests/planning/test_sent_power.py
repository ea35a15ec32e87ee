"""What transmitters send: by hand, along the algebra, against drawn channels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.planning.published import one_hop, two_hops

PLANT = hg.LinearPlant([[0.9]], [[0.19]], [2.0], [[1.0]])
SENSOR = hg.LinearSensor([[1.0]], 0.5)
FADING = hg.Discrete([0.5, 1.5], [0.5, 0.5])


def network(channel, plant=PLANT, sensor=SENSOR):
    return hg.Network(plant, {"node": hg.Node(sensor, channel, {})})


def test_a_chain_by_hand():
    """E y^2 = 1 + .5 in the steady state; the relay receives it by E g^2 = 1.25, with noise."""
    chain = hg.amplify_and_forward([hg.hop(FADING, 0.3, power=4.0), hg.hop(1.0, 0.1, amplification=2.0)])
    result = hg.power(network(chain))
    assert result.mean == pytest.approx({"node.hop1": 4 * 1.5, "node.hop2": 4 * (4 * 1.5 * 1.25 + 0.3)}, rel=1e-12)
    assert result.growth == pytest.approx(0.81) and result.words == "what is sent stays bounded"
    assert result.total == pytest.approx(sum(result.mean.values()))


def test_over_time_the_mean_counts():
    """x_0 has mean 2 and variance 1, which stays: E y^2 = 4 .81^k + 1.5."""
    result = hg.power(network(hg.hop(1.0, 0.3)), horizon=4)
    np.testing.assert_allclose(result.over_time["node.hop1"], 4 * 0.81 ** np.arange(1, 5) + 1.5, rtol=1e-12)
    assert result.peak["node.hop1"] == result.over_time["node.hop1"][0]
    np.testing.assert_array_equal(result.standard_error["node.hop1"], 0.0)


def test_an_unstable_plant_grows_and_says_so():
    plant = hg.LinearPlant([[1.1]], [[1.0]], [0.0], [[1.0]])
    wild = network(hg.hop(1.0, 0.2), plant)
    with pytest.raises(ValueError, match=r"steady power: expected a stable plant, or a horizon.*spectral radius 1\.1"):
        hg.power(wild)
    result = hg.power(wild, horizon=60)
    assert result.over_time["node.hop1"][[0, 59]] == pytest.approx([2.71, 5.3e5], rel=0.01)
    assert result.words == "the plant is unstable: what is sent grows by 1.21 a step, without limit"


def chain_of(kind):
    """Channels of every kind, two hops each, and how to see what their second transmitter receives."""
    first, second = hg.hop(FADING, 0.3), hg.hop(1.0, 0.1, amplification=1.5)
    chain = hg.random_affine.MarkovChain([[0.9, 0.1], [0.4, 0.6]], initial=[1.0, 0.0])
    return {
        "dropout": [hg.dropout(first, 0.7), second],
        "modes": [hg.random_affine.Modes(chain, [first, hg.hop(0.2, 0.5)]), second],
        "drift": [hg.model.autoregressive_fading(0.9, 1.0, 0.4, 0.3), second],
        "delay": [hg.hop(FADING, 0.3, delay=2), second],
        "erasure": [hg.erasure(first, 0.7), second],
    }[kind]


@pytest.mark.parametrize("kind", ["dropout", "modes", "drift", "delay", "erasure"])
def test_a_relay_sends_what_draws_of_the_first_hop_give_it(kind):
    hops = chain_of(kind)
    result = hg.power(network(hg.amplify_and_forward(hops)), horizon=3).over_time
    y2 = 4 * 0.81**3 + 1.5
    assert result["node.hop1"][2] == pytest.approx(y2, rel=1e-12)
    with jax.enable_x64(True):

        def received(key):
            begin, *keys = jax.random.split(key, 5)
            state = hops[0].init(begin)
            y = jnp.sqrt(y2)  # its sign and law do not matter: noise has mean zero
            for k in keys[:3]:
                state, h = hops[0].draw(state, k)
            z = h[0, :1] * y + h[0, -1] if kind != "delay" else h[:-1, :-1] @ jnp.tile(y, 3) + h[:-1, -1]
            return jnp.where(jnp.isnan(z[0]), 0.0, (1.5 * z[0]) ** 2)

        drawn = np.asarray(jax.jit(jax.vmap(received))(jax.random.split(jax.random.key(1), 40_000)))
    assert abs(drawn.mean() - result["node.hop2"][2]) < 4 * drawn.std() / 200


def test_stacks_wires_and_names():
    plant = hg.LinearPlant(0.5 * np.eye(2), np.eye(2), np.zeros(2), np.eye(2))
    sensor = hg.LinearSensor(np.eye(2), 0.1)
    relayed = hg.amplify_and_forward([hg.hop(FADING, 0.3), hg.hop(1.0, 0.1)])
    result = hg.power(hg.Network(plant, {"cart": hg.Node(sensor, hg.parallel([relayed, hg.perfect()]), {})}))
    assert list(result.mean) == ["cart.part1.hop1", "cart.part1.hop2"]  # a wire sends nothing


def test_a_nonlinear_plant_is_drawn():
    """The same linear plant written as a function: drawn powers agree with exact ones."""
    plant = hg.Plant(lambda x, u: 0.9 * x, 0.19, [2.0], [[1.0]], states=["x"])
    drawn = hg.power(network(hg.hop(FADING, 0.3), plant), horizon=4, runs=4000)
    exact = hg.power(network(hg.hop(FADING, 0.3)), horizon=4).over_time["node.hop1"]
    z = (drawn.over_time["node.hop1"] - exact) / drawn.standard_error["node.hop1"]
    assert np.max(np.abs(z)) < 3.5 and np.isnan(drawn.growth)
    with pytest.raises(ValueError, match="power: expected a horizon"):
        hg.power(network(hg.hop(FADING, 0.3), plant))


def test_relays_that_filter_send_what_their_design_says():
    hop = hg.hop(FADING, 0.3)
    slots = [
        {"north": {"sensor": hop}, "receiver": {"south": hop}},
        {"south": {"sensor": hop}, "receiver": {"north": hop}},
    ]
    relays = hg.model.RelayNetwork(PLANT, SENSOR, ["north", "south"], slots)
    design = hg.relays.local_error_design(relays, 10)
    schedules = hg.relays.relay_schedules(relays, design)
    receiver = hg.filters.ScheduledFilter(schedules.pop("receiver"))
    result = hg.power(hg.Network.of_relays(relays, schedules, {"best": receiver}))
    for name in ("north", "south"):
        np.testing.assert_allclose(result.over_time[name], design.power[name], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(result.over_time["sensor"], 4 * 0.81 ** np.arange(1, 11) + 1.5, rtol=1e-12)


def test_powers_given_are_powers_sent():
    """What a designed network sends over any chain is what was asked of it."""
    options = hg.design(two_hops(), budget=7, starts=1)
    np.testing.assert_allclose(
        list(hg.power(options.network).mean.values()), [p[0] for p in options.powers.values()], atol=1e-12
    )
    assert hg.power(one_hop()).total > 0


def test_the_steady_power_does_not_depend_on_the_modes_at_the_beginning():
    """A relay behind a chain that begins in its good mode receives half of its time .2 of the signal."""
    chain = hg.random_affine.MarkovChain([[0.5, 0.5], [0.5, 0.5]], initial=[1.0, 0.0])
    modes = hg.random_affine.Modes(chain, [hg.hop(1.0, 0.3), hg.hop(0.2, 0.3)])
    result = network(hg.amplify_and_forward([modes, hg.hop(1.0, 0.1)]))
    assert hg.power(result).mean["node.hop2"] == pytest.approx(0.3 + 1.5 * (1 + 0.2**2) / 2, rel=1e-12)
    varying = network(hg.model.over_time([hg.hop(1.0, 0.1, amplification=a) for a in (1.0, 2.0)]))
    with pytest.raises(ValueError, match=r"steady power: expected a network that does not vary \(give a horizon\)"):
        hg.power(varying)
    first = hg.power(result, horizon=1).mean["node.hop2"]
    assert first == pytest.approx(0.3 + (1 + 4 * 0.81 + 0.5), rel=1e-12)  # begins so, with a mean of 2


def test_a_mixture_of_a_noise_and_a_hop_has_one_transmitter():
    """Jamming without a signal is no transmitter; behind it a relay receives noise of .5, or the hop's 1.5 + .2."""
    atoms = hg.random_affine
    jamming = atoms.GainAndNoise(atoms.Constant(1.0), np.zeros((1, 1)), 0.5)
    mixture = atoms.Mixture([jamming, hg.hop(1.0, 0.2)], [0.3, 0.7])
    sent = hg.power(network(hg.amplify_and_forward([mixture, hg.hop(1.0, 0.1)]))).mean
    assert sent == pytest.approx({"node.hop1": 1.5, "node.hop2": 0.3 * 0.5 + 0.7 * 1.7}, rel=1e-12)


def test_a_steady_power_with_inputs_needs_a_horizon():
    """Inputs of 3 were ignored: the steady state is that of inputs of 0."""
    driven = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0, [[1.0]])
    assert hg.power(network(hg.hop(1.0, 0.3), driven)).total == pytest.approx(1 / 0.19 + 0.5, rel=1e-12)
    with pytest.raises(ValueError, match="inputs: expected a horizon"):
        hg.power(network(hg.hop(1.0, 0.3), driven), inputs=[[3.0]])


def test_one_sensor_with_feedback_does_not_hide_that_another_grows():
    """Feedback keeps what one node sends bounded; the other sends an unstable state."""
    plant, link = hg.LinearPlant([[1.2]], 1.0, [0.0], 1.0), hg.hop(1.0, 0.3)
    fed = hg.Node(SENSOR, link, {"fed": hg.filters.fed_back_filter(plant, SENSOR, link)})
    alone = hg.power(hg.Network(plant, {"fed": fed}), horizon=50)
    assert np.isnan(alone.growth) and alone.peak["fed.hop1"] < 3
    both = hg.power(hg.Network(plant, {"fed": fed, "plain": hg.Node(SENSOR, link, {})}), horizon=50)
    assert both.growth == pytest.approx(1.44, rel=1e-12) and "unstable" in both.words
    np.testing.assert_array_equal(both.over_time["fed.hop1"], alone.over_time["fed.hop1"])


def test_what_feedback_sends_after_losses_is_refused():
    """As if all arrived, .898 was said to be exact: with half of it lost E (y - r)^2 = 0.81 E P + 0.7 is 1.328."""
    plant, sensor, link = hg.LinearPlant([[0.9]], 0.5, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.2), hg.hop(1.0, 0.1)
    fed = hg.Node(sensor, hg.erasure(link, 0.5), {"fed": hg.filters.fed_back_filter(plant, sensor, link)})
    with pytest.raises(hg.InputError, match="power of 'a', a sensor with feedback: expected a link that loses nothing"):
        hg.power(hg.Network(plant, {"a": fed}), horizon=2)


def test_what_messages_tell_of_a_link_changes_nothing_of_what_is_sent():
    def sent(known, **horizon):
        fading = hg.hop(hg.Rayleigh(0.8), 0.2, known=known)
        return hg.power(network(hg.amplify_and_forward([fading, hg.hop(2.0, 0.1)])), **horizon).over_time

    for horizon in ({}, {"horizon": 3}):
        told, untold = sent(True, **horizon), sent(False, **horizon)
        assert list(told) == ["node.hop1", "node.hop2"]
        for name in told:
            np.testing.assert_allclose(told[name], untold[name], rtol=1e-12)
    declared = hg.model.told(lambda noise: hg.hop(1.0, noise * jnp.eye(1)), about=["variance"], typical=[2.0])
    with pytest.raises(ValueError, match=r"power of a link .* told: expected a known law of what is told, got none"):
        hg.power(network(declared))
