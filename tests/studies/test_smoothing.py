"""The example of smoothing: numbers known from elsewhere, and what simulation says."""

import json

import pytest

from heliograph_studies import smoothing

pytestmark = pytest.mark.slow

# A moving point: deviations sqrt(P_xx + P_yy) and mean traces, and variances of a lag's share of the filter's.
FILTER = {"10": 0.8678, "50": 2.6563, "90": 4.7837, "mean_trace": 9.7282}
SMOOTHER = {"10": 0.4950, "50": 1.5415, "90": 3.7904, "mean_trace": 5.0373}
LAG = {"1": 0.933, "5": 0.718, "10": 0.544, "20": 0.388}
# Relays in turn: traces in 1e-6, even and odd steps.
RELAYS = {"0": (5.2417, 5.2899), "1": (2.6024, 2.5493), "2": (1.9132, 1.8996), "5": (1.8396, 1.8229),
          "100": (1.7445, 1.7280)}  # fmt: skip


@pytest.fixture(scope="module")
def summary(tmp_path_factory, widths):
    out = tmp_path_factory.mktemp("example")
    smoothing.run(smoothing.Setting(runs=400), out)
    widths(out / "smoothing" / "report.html")
    assert {"report.html", "errors.svg", "deviations.svg"} <= {p.name for p in (out / "smoothing").iterdir()}
    return json.loads((out / "smoothing" / "summary.json").read_text())


def test_claims_before_data_are_the_known_ones(summary):
    point = summary["constant_velocity"]
    for item, known in ((point["filter"], FILTER), (point["smoother"], SMOOTHER)):
        assert item == pytest.approx(known, abs=6e-5)  # half of the last digit
    assert point["lag"] == pytest.approx(LAG, abs=6e-4)
    lags = summary["successive_relays"]["lag"]
    assert set(lags) == set(RELAYS)
    for lag, (even, odd) in RELAYS.items():
        assert lags[lag]["even"] * 1e6 == pytest.approx(even, abs=6e-5)
        assert lags[lag]["odd"] * 1e6 == pytest.approx(odd, abs=6e-5)


def test_simulation_agrees_and_innovations_tell_where_it_would_not(summary):
    for item in summary["measured"].values():
        assert 0.85 < item["nees"] < 1.15  # 400 runs whose steps are correlated: 0.04 is one standard error
    assert summary["measured"]["smoother"]["rmse"] < 0.8 * summary["measured"]["filter"]["rmse"]
    tame, large = summary["pendulum"]["tame"], summary["pendulum"]["large"]
    assert tame["smoother_angle"] < 0.7 * tame["filter_angle"] and tame["smoother_nees"] < 1.3
    assert large["smoother_nees"] > 1.2 * large["filter_nees"] > 200
    assert large["warned"] and not tame["warned"]
