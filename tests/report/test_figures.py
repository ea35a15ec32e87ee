import numpy as np
import pytest

from heliograph.report import png, svg
from heliograph_studies.curves import Curve, consistency_over_time, errors_with_bands, label_right, paths

BLUE, VERMILION = "#0072b2", "#d55e00"
TIME = np.linspace(0.1, 10.0, 50)
PATH = np.column_stack([np.cos(TIME), np.sin(TIME)])


def two_curves(values: np.ndarray, deviation: np.ndarray | None = None) -> list[Curve]:
    return [Curve("one", BLUE, values, deviation), Curve("two", VERMILION, 2 * values, deviation)]


def test_formats_and_determinism() -> None:
    first, second = (svg(paths(PATH, two_curves(PATH), np.zeros((1, 2)))) for _ in range(2))
    assert first == second
    assert b"<svg" in first
    assert png(paths(PATH, two_curves(PATH), np.zeros((1, 2))), 50).startswith(b"\x89PNG")


def test_band_is_drawn_at_the_stated_deviations() -> None:
    figure = errors_with_bands(TIME, two_curves(0.1 * PATH, np.full((50, 2), 0.5)), ("x", "y"), sigmas=3.0)
    assert len(figure.axes) == 4
    (band,) = figure.axes[0].collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (-1.5, 1.5)
    low, high = figure.axes[0].get_ylim()
    assert low == -high


def test_consistency_is_a_running_mean() -> None:
    values = np.concatenate([np.ones(25), np.full(25, 4.0)])
    figure = consistency_over_time(TIME, [Curve("one", BLUE, values)], window=10)
    drawn = figure.axes[0].lines[1].get_ydata()
    assert len(drawn) == 41
    np.testing.assert_allclose([drawn[0], drawn[20], drawn[-1]], [1.0, 2.5, 4.0])


@pytest.mark.parametrize("values", [(1.0, 1.0, 1.0), (1.0, 1.01, 50.0)])
def test_labels_keep_their_order_and_do_not_meet(values: tuple[float, ...]) -> None:
    axes = consistency_over_time(TIME, two_curves(np.geomspace(0.1, 100, 50)), window=5).axes[0]
    before = len(axes.texts)
    label_right(axes, {f"{i}": (v, BLUE) for i, v in enumerate(values)}, gap=0.1)
    heights = [text.get_position()[1] for text in axes.texts[before:]]
    assert np.all(np.diff(heights) > 0.1 - 1e-3)  # the passes converge geometrically
