from itertools import pairwise, product

import jax
import numpy as np
import pytest
from scipy.special import expit, logit
from scipy.stats import binomtest, chi2_contingency

import heliograph as hg
from heliograph.learning.packet_losses.hidden_mode_losses import FateRuns, HiddenModeLosses
from heliograph.learning.packet_losses.loss_laws import IndependentLosses, MarkovLosses

NAN = np.nan
LOGITS = logit([0.1, 0.6, 0.05, 0.2])  # loss when good, when bad, fail, recover
BURSTS = [np.array([0, 0, 1, NAN, 1, 1, 0.0]), np.array([1, 1, 0, 0.0])]


def hidden_chain(generator, packets, good=0.05, bad=0.7, fail=0.03, recover=0.15):
    mode, lost = 0, np.zeros(packets)
    for k, (u, v) in enumerate(generator.random((packets, 2))):
        lost[k] = u < (bad if mode else good)
        mode = int(v < fail) if mode == 0 else int(v >= recover)
    return lost


@pytest.fixture(scope="module")
def bursts():
    return hidden_chain(np.random.default_rng(0), 4000)


@pytest.fixture(scope="module")
def learned(bursts):
    return hg.learning.learn_losses(bursts)


def share(estimate):
    return hg.learning.Share(estimate, NAN, NAN)


def by_enumeration(fate, good, bad, fails, recovers):
    """P(fates): sum over all sequences of modes."""
    stay, loss, total = [[1 - fails, fails], [recovers, 1 - recovers]], (good, bad), 0.0
    for modes in product((0, 1), repeat=len(fate)):
        p = (recovers, fails)[modes[0]] / (fails + recovers)
        p *= np.prod([stay[a][b] for a, b in pairwise(modes)])
        p *= np.prod([1.0 if np.isnan(f) else loss[m] if f else 1 - loss[m] for f, m in zip(fate, modes, strict=True)])
        total += p
    return total


def test_the_hidden_modes_likelihood_is_the_sum_over_all_modes():
    shares = expit(LOGITS)
    expected = sum(np.log(by_enumeration(part, *shares)) for part in BURSTS)
    assert FateRuns.of(BURSTS).likelihood(LOGITS)[0] == pytest.approx(expected, rel=1e-13)
    law = HiddenModeLosses(*map(share, shares))
    assert np.nansum(law.log_likelihoods(BURSTS)) == pytest.approx(expected, rel=1e-13)


def test_its_gradient_is_that_of_differences(bursts):
    runs, step = FateRuns.of([bursts[:500]]), 1e-5 * np.eye(4)
    differences = [(runs.likelihood(LOGITS + e)[0] - runs.likelihood(LOGITS - e)[0]) / 2e-5 for e in step]
    np.testing.assert_allclose(runs.likelihood(LOGITS)[1], differences, rtol=1e-6)  # of central differences


@pytest.mark.slow
def test_it_finds_the_modes_it_was_drawn_from(learned):
    result = learned.laws["hidden"].shares()
    for name, truth in {"good_loss": 0.05, "bad_loss": 0.7, "fail": 0.03, "recover": 0.15}.items():
        assert result[name].low < truth < result[name].high
        assert result[name].high - result[name].low < 0.4 * np.sqrt(truth)  # 4,000 packets tell something


def test_the_profile_falls_by_half_the_chi_square_point_at_the_ends_of_an_interval(learned, bursts):
    """Where one share stands at an end of its interval and the others are the likeliest ones."""
    runs, shares = FateRuns.of([bursts]), learned.laws["hidden"].shares()
    top = runs.likelihood(logit([s.estimate for s in shares.values()]))
    assert np.max(np.abs(top[1])) < 1e-2
    for i, single in enumerate(shares.values()):
        for end in (single.low, single.high):
            x = logit([s.estimate for s in shares.values()])
            x[i] = logit(end)
            for _ in range(30):  # Newton in the three others, by differences of the gradient
                g = np.delete(runs.likelihood(x)[1], i)
                free = np.delete(np.arange(4), i)
                columns = [(runs.likelihood(x + 1e-4 * np.eye(4)[j])[1][free] - g) / 1e-4 for j in free]
                x[free] -= np.clip(np.linalg.solve(np.array(columns).T, g), -0.5, 0.5)
                if np.max(np.abs(g)) < 1e-6:
                    break
            fall = top[0] - runs.likelihood(x)[0]
            assert fall == pytest.approx(1.9207, abs=0.01)  # ends are found to 1e-3 in the logit


def test_counts_are_the_estimates_of_a_chain():
    law = MarkovLosses.fit(BURSTS)
    np.testing.assert_array_equal(law.counts, [[2, 1], [2, 2]])  # pairs across NaN and between stretches do not count
    assert law.shares()["fail"].estimate == 1 / 3 and law.shares()["recover"].estimate == 1 / 2
    assert IndependentLosses.fit(BURSTS).shares()["loss"].estimate == 0.5


def test_a_past_is_used_as_far_as_it_is_known():
    law = MarkovLosses(np.array([[7, 1], [2, 2], [4, 0], [1, 3.0]]))  # after 00, 01, 10, 11
    said = law.predicted(np.array([1, 0, NAN, 1, 1, 0.0]))
    assert said.tolist() == [6.5 / 21, 5.5 / 9, 0.5 / 5, 6.5 / 21, 5.5 / 9, 3.5 / 5]


@pytest.mark.parametrize("hits, of", [(3, 20), (0, 10), (10, 10), (37, 400)])
def test_intervals_of_counts_are_wilsons(hits, of):
    expected = binomtest(hits, of).proportion_ci(0.95, "wilson")
    share = IndependentLosses.fit([np.arange(of) < hits]).shares()["loss"]
    np.testing.assert_allclose((share.estimate, share.low, share.high), (hits / of, *expected), atol=1e-14)


@pytest.mark.slow
def test_the_running_rate_is_a_recursion(learned, bursts):
    law, rate, said = learned.laws["running"], None, []
    base, weight, step = (s.estimate for s in law.shares().values())
    some = np.where(np.arange(200) % 7 == 3, NAN, bursts[:200])
    rate = base
    for lost in some:
        said.append((1 - weight) * base + weight * rate)
        rate += 0 if np.isnan(lost) else step * (lost - rate)
    np.testing.assert_allclose(law.predicted(some), said, rtol=1e-12)


def test_tests_of_memory_are_the_known_ones(bursts):
    result = hg.learning.LossMemory.of(bursts)
    table = MarkovLosses.fit(bursts).counts
    expected = chi2_contingency(table, correction=False, lambda_="log-likelihood")
    assert result.likelihood_ratio == pytest.approx(expected.statistic, rel=1e-10)
    assert result.significant and result.runs_z < -5


def test_tests_of_memory_find_none_where_there_is_none():
    """2,000 recordings of 300 independent losses: a test at 5 % rejects 5 %, to three standard errors."""
    drawn = (np.random.default_rng(1).random((2000, 300)) < 0.3).astype(float)
    results = [hg.learning.LossMemory.of(item) for item in drawn]
    for p in ("likelihood_p", "runs_p"):
        assert np.mean([getattr(item, p) < 0.05 for item in results]) == pytest.approx(0.05, abs=0.0146)


def test_nothing_that_varies_is_no_evidence():
    result = hg.learning.LossMemory.of(np.zeros(20))
    assert (result.likelihood_p, result.runs_p) == (1.0, 1.0)


def test_the_law_that_predicts_best_is_chosen(learned):
    said = {name: item.gain for name, item in learned.held_out.items()}
    assert learned.best == "hidden"
    assert said["independent"] == 0 < said["markov"] < said["markov_4"] < said["hidden"]
    assert learned.held_out["hidden"].gain > 4 * learned.held_out["hidden"].gain_error


def test_without_packets_held_out_the_hidden_mode_is_chosen_where_it_is_significant(bursts):
    """Ten packets are too few to say that losses remember."""
    assert hg.learning.learn_losses(bursts[:500], held_out=0).best == "hidden"
    assert hg.learning.learn_losses(BURSTS, held_out=0).best == "independent"


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_independent_losses_are_called_independent(seed):
    """By the field and by the channel alike: of these recordings a chain, a mode or a long chain predicts better."""
    found = hg.learning.learn_losses((np.random.default_rng(seed).random(200) < 0.3).astype(float))
    assert max(found.held_out, key=lambda name: found.held_out[name].log_likelihood) != "independent"
    assert found.best == found.best_channel == "independent"
    (loss,) = found.laws["independent"].shares().values()
    assert repr(found.channel(hg.hop(1.0, 0.1))) == repr(hg.erasure(hg.hop(1.0, 0.1), 1 - loss.estimate))


@pytest.mark.slow
def test_a_drifting_rate_that_predicts_best_leaves_the_next_best_to_the_channel():
    """Rates from 5 % to 60 % and back, slowly: `best` is a rate that no channel has."""
    rate = 0.325 - 0.275 * np.cos(np.arange(3000) / 240)
    found = hg.learning.learn_losses((np.random.default_rng(4).random(3000) < rate).astype(float))
    assert found.best_channel in ("markov", "markov_4", "hidden")
    assert found.channel(hg.hop(1.0, 0.1)) is not None
    assert found.best in ("running", found.best_channel)


def test_independent_losses_are_said_from_bursts():
    result = hg.learning.learn_losses((np.random.default_rng(2).random(600) < 0.2).astype(float))
    assert not result.memory.significant
    assert abs(result.held_out["hidden"].gain) < 3 * result.held_out["hidden"].gain_error + 1e-3
    assert result.held_out["markov_4"].gain < 0  # 16 numbers fitted for nothing


@pytest.mark.parametrize("name", ["independent", "markov", "markov_4", "hidden"])
def test_a_law_is_a_channel_with_its_losses(learned, name):
    """Long-run losses of the channel against those of the law; 4,000 drawn packets in bursts: three standard errors."""
    channel = learned.laws[name].channel(hg.hop(1.0, 0.01))

    def step(state, key):
        state, h = channel.draw(state, key)
        return state, h[0, 0]

    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(3), 4000)
        lost = np.isnan(np.asarray(jax.lax.scan(step, channel.init(keys[0]), keys)[1]))
    assert lost.mean() == pytest.approx(learned.lost / learned.packets, abs=0.045)
    law = MarkovLosses.fit(lost.astype(float)).shares()
    truth = learned.laws["markov"].shares()["recover"].estimate if name != "independent" else 1 - lost.mean()
    assert law["recover"].estimate == pytest.approx(truth, abs=0.09)


@pytest.mark.parametrize(("fate", "lost"), [(0.0, 0.0), (1.0, 1.0)])
def test_a_chain_that_was_never_left_is_a_channel(fate, lost):
    """What follows the fate that never came has even odds, as for the longer chain; it was a message about NaN."""
    law = hg.learning.learn_losses(np.full(50, fate)).laws["markov"]
    chain = hg.random_affine.joint_modes(law.channel(hg.hop(1.0, 0.01)))
    np.testing.assert_allclose(chain.transition, [[1 - lost, lost], [0.5, 0.5]] if not lost else [[0.5, 0.5], [0, 1]])
    np.testing.assert_allclose(chain.initial, [1 - lost, lost], atol=1e-12)


def test_a_drifting_rate_is_no_channel(learned):
    with pytest.raises(ValueError, match="channel with RunningRateLosses: expected a law with finitely many states"):
        learned.laws["running"].channel(hg.perfect())
    assert learned.channel(hg.perfect()).remembers
