import numpy as np

from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import BLUE, INK, Curve, svg


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
