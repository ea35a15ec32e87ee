"""Learning a network with angles: the likelihood is that of what was received around the circle."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics import wrap_angles

STEPS, PROCESS, NOISE = 150, 0.01, 0.04


def compass(process, noise, circular=True):
    """A heading that wanders, and a compass."""
    names = ["heading"] if circular else []
    plant = hg.LinearPlant([[1.0]], process, [3.0], 0.5, states=["heading"], circular=names)
    sensor = hg.LinearSensor([[1.0]], noise, outputs=["compass"], circular=["compass"] if circular else [])
    filter = hg.kalman_filter(plant, sensor)
    return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": filter})}), filter


def heard():
    rng = np.random.default_rng(0)
    truth = 3.0 + np.cumsum(np.sqrt(PROCESS) * rng.normal(size=STEPS))
    return truth, truth + np.sqrt(NOISE) * rng.normal(size=STEPS)


@pytest.mark.slow
def test_a_compass_is_learned_as_well_as_one_on_a_line_that_was_wound_up():
    """The same data without their turns; the best numbers and their likelihood are those of a grid, too."""
    _, wound = heard()
    z = wrap_angles(wound[:, None], (0,))
    assert z.max() > 3 and z.min() < -3
    circle, line = (
        hg.fit(lambda c=c: compass(hg.free(0.1), hg.free(0.1), c)[0], {"a": rows})
        for c, rows in ((True, z), (False, wound[:, None]))
    )
    best = [row.estimate for row in circle.rows()]
    assert best == pytest.approx([row.estimate for row in line.rows()], rel=1e-4)  # both searches end by gradient
    grid = [(p, r) for p in np.geomspace(0.8, 1.25, 5) * best[0] for r in np.geomspace(0.8, 1.25, 5) * best[1]]
    values = [hg.log_likelihood(compass(p, r)[1], z, np.zeros((STEPS, 0))) for p, r in grid]
    assert np.allclose(grid[int(np.argmax(values))], best)  # the middle of the grid


def bearings(noise):
    """A target in the west that stands still, its bearings from two nodes across pi and -pi."""
    plant = hg.Plant(lambda x, u: x, 1e-6 * np.eye(2), [-9.5, 0.2], 0.25 * np.eye(2))
    nodes = {}
    for name, y in (("a", 0.0), ("b", 3.0)):
        sensor = hg.Sensor(lambda x, y=y: jnp.arctan2(x[1] - y, x[0])[None], noise, ["bearing"], ["bearing"])
        nodes[name] = hg.Node(sensor, hg.perfect(), {"f": hg.cubature_filter(plant, sensor)})
    return hg.Network(plant, nodes)


@pytest.mark.slow
def test_two_nodes_with_bearings_are_learned_as_a_grid_has_it():
    rng = np.random.default_rng(1)
    z = {
        n: wrap_angles(np.arctan2(-y, -10.0) + 0.05 * rng.normal(size=(STEPS, 1)), (0,))
        for n, y in (("a", 0), ("b", 3))
    }
    assert z["a"].max() > 3 and z["a"].min() < -3
    fit = hg.fit(lambda: bearings(hg.free(1e-3)), z)
    (row,) = fit.rows()
    grid, both = np.geomspace(1.5e-3, 4e-3, 61), np.concatenate([z["a"], z["b"]], axis=1)

    def likelihood(noise):
        sensor = hg.model.joint_sensor({name: node.sensor for name, node in bearings(noise).nodes.items()})
        return hg.log_likelihood(hg.cubature_filter(bearings(noise).plant, sensor), both, np.zeros((STEPS, 0)))

    values = [likelihood(noise) for noise in grid]
    step = grid[1] / grid[0]
    assert 1 / step < row.estimate / grid[int(np.argmax(values))] < step  # to a step of the grid
    assert row.estimate == pytest.approx(0.05**2, rel=4 * np.sqrt(2 / (2 * STEPS)))  # four deviations of a variance
