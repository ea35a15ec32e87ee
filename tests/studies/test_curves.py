import numpy as np

from heliograph.report import svg
from heliograph_studies.curves import Curve, Panel, curves_over, curves_over_time

BLUE, INK = "#0072b2", "#1f2933"


def test_each_panel_has_its_curves_and_names_them():
    time = np.arange(20.0)
    wave = np.sin(time)
    second = Panel("b", [Curve("x", INK, wave), Curve("g", BLUE, time)])
    figure = curves_over_time(time, [Panel("a", [Curve("wave", BLUE, wave)]), second])
    assert [len(axes.lines) for axes in figure.axes] == [1, 2]
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_ydata(), wave)
    assert [text.get_text() for text in figure.axes[1].texts] == ["x", "g"]
    assert figure.axes[1].get_xlabel() == "step" and figure.axes[0].get_ylabel() == "a"
    assert svg(figure).startswith(b"<?xml")


def test_marks_stand_where_they_are_named_and_gaps_stay_open():
    where = np.linspace(0.0, 1.0, 11)
    values = np.where(where < 0.35, np.nan, 1 / np.maximum(where, 0.1))
    figure = curves_over(where, Panel("error", [Curve("bound", BLUE, values)]), "arrival", {"0.36": 0.36})
    (axes,) = figure.axes
    curve, mark = axes.lines
    np.testing.assert_array_equal(curve.get_ydata(), values)
    assert list(mark.get_xdata()) == [0.36, 0.36]
    assert [text.get_text() for text in axes.texts] == ["0.36", "bound"]
    assert axes.get_yscale() == "log" and axes.get_xlabel() == "arrival"


def test_a_curve_that_ends_early_is_named_at_its_end():
    time = np.arange(20.0)
    early = np.where(time < 10, 3.0, np.nan)
    figure = curves_over_time(time, [Panel("a", [Curve("early", BLUE, early), Curve("late", INK, 0 * time)])])
    axes = figure.axes[0]
    heights = {text.get_text(): text.get_position()[1] for text in axes.texts}
    at = axes.transAxes.inverted().transform(axes.transData.transform((0.0, 3.0)))[1]
    assert heights["early"] > 0.9 * at and heights["late"] < 0.1
