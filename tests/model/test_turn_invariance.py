"""Maps that a full turn of an angle changes are refused, also where they change nothing at the plant's own start."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

NOISE = np.eye(2) / 100
GRID = np.linspace(0.0, 2 * np.pi, 9)  # of a compass card, whose deviation is 0 at both ends

MOVED = {
    "half the angle": lambda x, u: jnp.stack([x[0] + x[1], 0.9 * x[1] + jnp.sin(x[0] / 2)]),
    "angle times rate": lambda x, u: jnp.stack([x[0] + x[1], 0.9 * x[1] - x[0] * x[1]]),
    "angle times input": lambda x, u: jnp.stack([x[0] + x[1], 0.9 * x[1] + u[0] * x[0]]),
}


@pytest.mark.parametrize("name", MOVED)
def test_a_turn_is_tried_at_a_state_that_is_no_special_case(name):
    """All three are 0 at angle 0, rate 0 and input 0, with a full turn as without one."""
    with pytest.raises(ValueError, match="plant with circular states: expected one that a full turn does not change"):
        hg.Plant(MOVED[name], NOISE, np.zeros(2), np.eye(2), inputs=["u"], circular=["x0"])


def test_a_turn_is_tried_with_inputs():
    with pytest.raises(ValueError, match=r"plant with circular states: .*a turn of state 0"):
        hg.LinearPlant(
            lambda u: jnp.array([[1.0, 0.0], [u[0], 1.0]]), NOISE, [0, 0], np.eye(2), inputs=["u"], circular=["x0"]
        )


@pytest.mark.parametrize(("period", "refused"), [(None, True), (2 * np.pi, False)])
def test_a_table_over_one_turn_needs_its_period(period, refused):
    plant = hg.LinearPlant([[1.0]], 0.01, [0.0], 1.0, circular=["x0"])
    card = hg.Sensor(lambda x: jnp.interp(x, GRID, jnp.sin(GRID), period=period), [[0.1]], ["y0"])
    if refused:
        with pytest.raises(ValueError, match="sensor of a plant with circular states"):
            hg.cubature_filter(plant, card, hg.perfect())
    else:
        assert hg.cubature_filter(plant, card, hg.perfect()).claim == "nominal"


def test_what_a_turn_does_not_change_is_taken_anywhere():
    """A turning robot, far from the origin, whose map has no number where one state is below 0."""
    plant = hg.Plant(
        lambda x, u: jnp.stack([x[0] + u[0], x[1] + jnp.cos(x[0]) * jnp.sqrt(x[2]), x[2]]),
        np.eye(3) / 100,
        [3.0, 1e7, 0.1],
        np.eye(3),
        inputs=["turn"],
        circular=["x0"],
    )
    assert plant.circular == ("x0",)


def test_a_turn_is_tried_with_inputs_that_are_no_special_case():
    """An angle times a whole number has whole turns more after a turn; times .6 it has not."""
    with pytest.raises(ValueError, match=r"plant with circular states: .*a turn of state 0"):
        hg.Plant(lambda x, u: u[0] * x, 0.01, [0.0], 1.0, inputs=["u"], circular=["x0"])
    plant = hg.Plant(lambda x, u: x + u[0], 0.01, [0.0], 1.0, inputs=["u"], circular=["x0"])
    scaled = hg.Sensor(lambda x, u: u[0] * x, 0.1, ["y0"], inputs=["u"], circular=["y0"])
    with pytest.raises(ValueError, match="sensor of a plant with circular states"):
        hg.cubature_filter(plant, scaled, hg.perfect())
