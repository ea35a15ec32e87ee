"""What is learned against true states: errors with memory, of which a likelihood takes too little, and late stamps."""

import numpy as np
import pytest

import heliograph as hg

DT, LATE, MEMORY = 0.1, 0.2, 0.95
NOISE = 0.3 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])


def drive(seed, steps=600):
    """A walk in one dimension, seen late and with an error of 0.3 that changes over 20 rows."""
    rng = np.random.default_rng(seed)
    x, error, states, values = np.zeros(2), 0.0, [], []
    for _ in range(steps):
        x = np.array([x[0] + DT * x[1], x[1]]) + np.linalg.cholesky(NOISE) @ rng.standard_normal(2)
        error = MEMORY * error + np.sqrt(1 - MEMORY**2) * 0.3 * rng.standard_normal()
        states.append([*x, np.nan, np.nan])  # of the clock nothing is known
        values.append([x[0] - LATE * x[1] + error + 0.02 * rng.standard_normal()])
    return np.array(values), np.array(states)


def network(filters=True):
    """White noise of a free variance, and a clock whose delay is free."""
    plant = hg.LinearPlant([[1.0, DT], [0.0, 1.0]], NOISE, [0.0, 0.0], 1e-6 * np.eye(2), states=["x", "v"])
    sensor = hg.LinearSensor([[1.0, 0.0]], hg.free(0.01, "r"))
    clock = hg.model.Clock(0.0, 0.0, delay=hg.free(0.0, "delay"))
    plant, sensors = hg.model.with_clocks(plant, {"a": sensor}, {"a": clock}, [[0.0, 1.0], [0.0, 0.0]], DT)
    chosen = {"extended": hg.extended_filter(plant, sensors["a"], hg.perfect())} if filters else {}
    return hg.Network(plant, {"a": hg.Node(sensors["a"], hg.perfect(), chosen)})


def nees(item, seeds):
    values = []
    for seed in seeds:
        z, truth = drive(seed)
        result = item.run(z)
        errors = (result.means - truth)[:, :2]
        values.append(np.einsum("ti,tij,tj->t", errors, np.linalg.inv(result.covariances[:, :2, :2]), errors)[20:])
    return np.mean(values) / 2


def test_numbers_learned_by_the_truth_give_a_claim_that_is_true_on_other_drives():
    """NEES of 20 drives of some 30 independent errors each: 1 to 6 % for what is drawn, 15 % for what is learned.

    The likelihood of the measurements takes the 0.02 between rows for the noise, and claims a hundredth of the square.
    """
    drives = [drive(seed) for seed in range(3)]
    z, truth = ([part[i] for part in drives] for i in (0, 1))
    learned = hg.fit(network, z, starts=1, truth=truth)
    rows = {row.name: row for row in learned.table}
    assert rows["delay"].form == "truth" and rows["delay"].low < LATE < rows["delay"].high
    assert rows["delay"].high - rows["delay"].low < 0.1
    assert 0.8 < nees(learned.network.nodes["a"].filters["extended"], range(10, 30)) < 1.25
    by_measurements = hg.fit(network, z, starts=1)
    assert nees(by_measurements.network.nodes["a"].filters["extended"], range(10, 13)) > 10


@pytest.mark.parametrize(("change", "message"), [
    ({"network": lambda: network(False)}, "network to be learned by its true states: expected one filter"),
    ({"truth": True}, "truth: expected the true states of each of the 1 recordings, got none"),
    ({"truth": np.zeros((5, 4))}, "truth: expected shape"),
    ({"truth": np.full((50, 4), np.nan)}, "numbers of the truth for 2 free ones"),
])  # fmt: skip
def test_what_holds_no_truth_is_refused_in_one_line(change, message):
    z, truth = drive(0, 50)
    arguments = {"network": network, "truth": truth} | change
    with pytest.raises(ValueError, match=message) as caught:
        hg.fit(arguments["network"], z, truth=arguments["truth"], starts=1)
    assert "\n" not in str(caught.value)
