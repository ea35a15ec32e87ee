"""Side information of a receiver: outcomes against draws."""

import numpy as np
import pytest

import heliograph as hg
from tests.draws import draw

HALF = hg.erasure(hg.hop(hg.Discrete([0.5, 1.0], [0.3, 0.7]), 0.1), 0.5)


def relayed():
    """Two sensors' packets, one lost on the way to a relay that adds both, and one of the relay's outputs lost."""
    first = hg.parallel([HALF, hg.erasure(hg.perfect(), 0.8)])
    adding = hg.random_affine.known([[1.0, 1.0], [0.0, 2.0]])
    return hg.amplify_and_forward([first, adding, hg.parallel([hg.perfect(), hg.erasure(hg.perfect(), 0.9)])])


@pytest.mark.slow
@pytest.mark.parametrize("channel", [HALF, hg.model.with_direct_link(HALF, hg.perfect()), relayed()])
def test_outcomes_are_those_of_draws(channel):
    """Frequencies of each set of losses in 4,000 draws, within 4 standard errors, and the mean map of what arrived."""
    draws = draw(channel.sample, 4000)[:, :-1]
    arrived = ~np.isnan(draws).any(axis=2)
    result = channel.list_outcomes()
    np.testing.assert_allclose(sum(o.probability for o in result), 1.0)
    for kind in {tuple(o.arrived) for o in result}:
        alike = [o for o in result if tuple(o.arrived) == kind]
        p = sum(o.probability for o in alike)
        those = draws[(arrived == kind).all(axis=1)][:, list(kind)]
        assert abs(len(those) / 4000 - p) < 4 * np.sqrt(p * (1 - p) / 4000) + 1e-12
        mean = sum(o.probability / p * np.asarray(o.map.moments(1).mean)[:-1][list(kind)] for o in alike)
        error = those.std(axis=0) / np.sqrt(len(those))
        assert np.all(np.abs(those.mean(axis=0) - mean) < 4.5 * error + 1e-6)


def test_a_channel_without_erasures_tells_nothing():
    (only,) = hg.dropout(hg.perfect(), 0.5).list_outcomes()
    assert only.probability == 1 and only.arrived.all()


def test_what_never_happens_is_left_out():
    (only,) = hg.erasure(hg.perfect(), 1.0).list_outcomes()
    assert only.arrived.all()


def test_what_cannot_be_said_is_refused():
    mixed = hg.random_affine.Mixture([HALF, hg.perfect()], [0.5, 0.5])
    with pytest.raises(ValueError, match="channel with erasures: expected erasures in series and stacks, got Mixture"):
        mixed.list_outcomes()
    with pytest.raises(ValueError, match="expected at most 1024 sets of losses, got 2,048"):
        hg.parallel([HALF] * 11).list_outcomes()
