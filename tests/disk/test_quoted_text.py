"""Names from outside, where they land."""

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.disk import quote_for_cell, unquote_cell, visible

matplotlib.use("agg")


@pytest.mark.slow
@given(st.text())
def test_a_cell_is_no_formula_and_can_be_read_again(text):
    cell = quote_for_cell(text)
    assert not cell.startswith(("=", "+", "-", "@", "\t", "\r")) and unquote_cell(cell) == visible(text)


@pytest.mark.slow
@given(st.text())
def test_what_is_visible_moves_no_cursor(text):
    assert all(c.isprintable() for c in visible(text))


@pytest.mark.parametrize("name", ["$\\bad{$", "$", "a$b$c", "_hidden", "\\$x$", "\x1b[31m", "plain"])
def test_a_figure_draws_any_name_and_shows_it_in_the_legend(name):
    figure = Figure()
    axes = figure.subplots()
    estimate = hg.model.Estimate(np.zeros((2, 1)), np.ones((2, 1, 1)), "exact")
    hg.Record(np.arange(2.0), (name,), None, {}, {"node": {name: estimate}}).plot(
        axes=axes
    )  # the state's name is at the axis
    assert len(axes.get_legend().get_texts()) == 1 and axes.get_ylabel()
    figure.canvas.draw()
