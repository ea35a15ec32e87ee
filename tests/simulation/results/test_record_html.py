"""What a notebook shows of a record: estimates with their bands, on any width, whatever the names are."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

import heliograph as hg

TIMES = np.datetime64("2026-11-29T10:00", "ns") + np.arange(40) * np.timedelta64(1, "s")
PLANT = hg.LinearPlant(
    [[1.0, 0.1], [0.0, 1.0]], 0.01 * np.eye(2), [0.0, 1.0], np.eye(2), states={"<b>level</b>": "m", "flow": "m/s"}
)
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.1)


def record(rows=40, time=TIMES):
    kalman = hg.kalman_filter(PLANT, SENSOR)
    filters = {"kalman": kalman, "doubtful & <i>": hg.linear_filter(PLANT, SENSOR, hg.hop(0.8, noise=0.1))}
    network = hg.Network(PLANT, {"n": hg.Node(SENSOR, hg.erasure(hg.perfect(), 0.9), filters)})
    z = np.where(np.arange(rows) % 7 == 3, np.nan, np.sin(np.arange(rows) / 5))[:, None]
    return hg.run(network, {"n": z}, time=time)


def curves(shown):
    """The points of each line of each panel, in the units of the drawing."""
    panels = re.findall(r"<svg.*?</svg>", shown)
    lines = [re.findall(r'<path d="([^"]*)" fill="none" stroke="#', panel) for panel in panels]
    return [[np.array(re.findall(r"([\d.]+) ([\d.-]+)", d), dtype=float) for d in of] for of in lines]


def test_means_and_bands_are_those_of_the_estimates():
    one = record()
    shown = one._repr_html_()
    ElementTree.fromstring(shown)  # well formed, and no name ends an element
    assert "<b>level" not in shown and "&lt;b&gt;level&lt;/b&gt; (m)" in shown and "2026-11-29T10:00:39" in shown
    estimate = one.estimates["n"]["kalman"]
    deviation = np.sqrt(np.asarray(estimate.covariance)[:, 0, 0])
    assert f"last {estimate.mean[-1, 0]:.4g} ± {2 * deviation[-1]:.2g}" in shown
    (mean, _), _ = curves(shown)
    # On the axis of the panel the mean is an affine function of what is drawn: rounded to a hundredth of a unit of 100.
    expected = np.polyfit(mean[:, 1], estimate.mean[:, 0], 1)
    height = abs(100 * expected[0])
    np.testing.assert_allclose(np.polyval(expected, mean[:, 1]), estimate.mean[:, 0], atol=1e-4 * height)
    band = re.search(r'<path d="M([^"]*)Z" fill="#0072b2"', shown)[1]
    ends = np.array([pair.split() for pair in band.split("L")], dtype=float)
    upper, lower = ends[:40, 1], ends[40:, 1][::-1]
    np.testing.assert_allclose(expected[0] * (upper - lower), 4 * deviation, atol=2e-4 * height)


def test_a_long_record_is_thinned_and_odd_ones_are_shown():
    shown = record(3000, np.arange(3000.0))._repr_html_()
    assert len(curves(shown)[0][0]) == 500 and "500 rows of 3000 drawn" in shown and len(shown) < 100_000
    assert "no estimates" in hg.Record(np.arange(2.0), ("x",), None, {}, {})._repr_html_()
    plant, sensor = hg.LinearPlant([[1.0]], 0.0, [2.0], 0.0), hg.LinearSensor([[1.0]], 1.0)
    still = hg.Network(plant, {"n": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
    assert "1 row<" in (one := hg.run(still, {"n": np.ones((1, 1))})._repr_html_()) and "last 2 ±" in one
    runs = hg.monte_carlo(still, horizon=3, runs=2, key=0)
    assert "3 rows of 2 runs, the first drawn" in runs._repr_html_() and "truth" in runs._repr_html_()


@pytest.mark.parametrize(
    ("start", "step", "ends"),
    [
        (0.0, 0.1, ("21", "21.2")),  # 21.200000000000003 in double precision
        (1.7e9, 0.1, ("1700000021", "1700000021.2")),  # since 1970: not "1.7e+09" twice
        (TIMES[0], np.timedelta64(100, "ms"), ("2026-11-29T10:00:21.000", "2026-11-29T10:00:21.200")),
        (TIMES[0], np.timedelta64(1, "s"), ("2026-11-29T10:03:30", "2026-11-29T10:03:32")),
    ],
)
def test_times_as_texts_differ_where_the_times_do(start, step, ends):
    shown = record(3, start + np.arange(210, 213) * step)._repr_html_()
    assert tuple(re.findall(r"<span>([^<]*)</span>", shown)[-2:]) == ends


@pytest.mark.real("browser")
def test_it_fits_a_window(fits):
    """In a browser at 1200 and 420 pixels, where there is one."""
    head = '<!doctype html><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    fits(f"{head}<body>{record()._repr_html_()}</body>")
