"""Rows of a radio network's log, and what a filter makes of packets that come late."""

from pathlib import Path

import numpy as np
import pytest

from heliograph import cli
from heliograph.live.timeline import Timeline
from heliograph.report import svg
from heliograph_studies.demo.recording import read_recording
from heliograph_studies.late_data import Setting, example, figures, plaza
from heliograph_studies.late_data.compute import Outcome, Trace, through_moving, through_plaza
from heliograph_studies.late_data.packets import SLOT, Packets, read_trace, statistics, synthetic_packets
from heliograph_studies.late_data.plaza import fates_by_node
from heliograph_studies.settings import differences
from heliograph_studies.stages import Stages
from heliograph_studies.study import no_progress

pytestmark = pytest.mark.slow


def row(node, sequence, sent, received, clock="0:00:01.000000"):
    """As the testbed writes it: flag, slots and number with their lowest byte first, flag, hops."""
    results = [7, *received.to_bytes(5, "little"), *sent.to_bytes(5, "little"), *sequence.to_bytes(2, "little"), 0]
    return f"{[*results, node, 3, 26, 55, 11, 2, 15, 84, *[0] * 16]}\t{clock}"


def written(path, rows):
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_log_is_read_as_the_testbed_wrote_it(tmp_path):
    rows = [
        row(2, 300, 70_000, 70_010),
        row(3, 65_535, 70_020, 2**32 + 5),  # numbers of more than one byte, and of more than four
        row(2, 301, 70_100, 70_130),
        row(2, 300, 70_000, 70_140),  # a copy
        "",
        row(2, 302, 70_300, 70_299),  # received before it was sent
        row(0, 302, 70_300, 70_310),  # from nobody
        row(2, 302, 70_300, 70_310)[:40],  # cut off
        row(2, 302, 70_300, 70_310).replace("26", "256"),
    ]
    packets, odd = read_trace(written(tmp_path / "log", rows))
    assert odd == 4 and packets.node.tolist() == [2, 3, 2, 2] and packets.sequence.tolist() == [300, 65_535, 301, 300]
    np.testing.assert_allclose(packets.sent, np.array([0, 20, 100, 0]) * SLOT)
    np.testing.assert_allclose(packets.received[1], (2**32 + 5 - 70_000) * SLOT)
    assert packets.first_received().tolist() == [True, True, True, False]


def test_losses_are_gaps_within_a_boot_sorted_by_the_time_of_sending(tmp_path):
    """Node 2: 1 2 . 4 5, received with 4 and 2 swapped; a reboot: 1 . . 4; a lone packet of node 9 after 300 others."""
    first = [(1, 10), (4, 40), (2, 20), (5, 50)]
    again = [(1, 110), (4, 140)]
    rows = [row(2, n, slot, slot + 35 if n == 2 else slot + 5) for n, slot in first + again] + [row(9, 300, 60, 61)]
    packets, _ = read_trace(written(tmp_path / "log", rows))
    result = statistics(packets)
    assert (result.packets, result.nodes, result.boots) == (7, 2, 3)
    assert result.lost == 3 / 10 and result.run_max == 2 and result.run_mean == 1.5
    assert result.lost_after_lost == 1 / 3  # of the three lost ones one is followed by another
    assert result.out_of_order == 2 / 6 and result.out_of_order_by_node == 1 / 5 and result.copies == 0
    fates = [np.isnan(fate).tolist() for fate in packets.fates()]
    assert fates == [[False, False, True, False, False], [False, True, True, False], [False]]
    assert [len(part) for part in fates_by_node(packets)] == [9, 1]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected rows of 38 bytes in brackets, a tab and a time, got an empty file"),
        (b"time,x\n1,2\n", "expected rows of 38 bytes in brackets, a tab and a time, got 'time,x' and 1 like it"),
        (b"\xff\xfe", "expected a log in UTF-8, got 'utf-8' codec"),
        (None, "expected a file, got nothing of that name"),
    ],
)
def test_what_is_no_log_is_said_in_one_line(tmp_path, content, message, capsys):
    path = tmp_path / "log"
    if content is not None:
        path.write_bytes(content)
    assert cli.main(["example", "late-data", "--out", str(tmp_path / "out"), "--trace", str(path)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert message in lines[-1] and str(path) in lines[-1]


def test_a_log_too_short_is_said_in_one_line(tmp_path, capsys):
    path = written(tmp_path / "log", [row(2, k, 100 * k, 100 * k + 3) for k in range(20)])
    assert cli.main(["example", "late-data", "--out", str(tmp_path / "out"), "--trace", str(path)]) == 2
    expected = "trace: expected packets sent from 300 to 1200 s after the first, got 0 of 20 over 28 s"
    assert expected in capsys.readouterr().err


def test_another_example_takes_no_trace(tmp_path, capsys):
    assert cli.main(["example", "live", "--out", str(tmp_path), "--trace", "x"]) == 2
    error = capsys.readouterr().err
    assert error == "heliograph: --trace: expected an example that takes it, got 'live'\n"


def test_a_log_is_known_by_what_it_holds_and_shown_by_its_name(tmp_path):
    path = tmp_path / "some.log"
    path.write_text("one")
    setting = Setting(trace=path)
    before = example._key(setting)
    assert example._key(Setting(trace=str(path))) == before
    path.write_text("two")
    assert example._key(setting) != before
    assert differences(setting, Setting())["trace"] == ("–", "some.log")
    assert "--set trace=some.log" in example.command(setting) and str(tmp_path) not in example.command(setting)


def test_the_synthetic_network_has_the_published_statistics():
    """Within what 20,000 packets leave to chance, three deviations and more."""
    result = statistics(synthetic_packets(10_000.0, 1))
    assert abs(result.lost - 0.099) < 0.01 and abs(result.lost_after_lost - 0.27) < 0.03
    assert abs(result.copies - 0.15) < 0.01 and abs(result.delay_median - 0.38) < 0.02
    assert abs(result.delay_95 - 2.2) < 0.2 and result.delay_max < 85.5 and abs(result.out_of_order - 0.24) < 0.05


def test_rewinding_is_honest_and_taking_data_as_current_is_not():
    """One path of two minutes: 120 moments whose errors are correlated over a few, so NEES within 0.3 of 1."""
    setting = Setting(runs=1, duration=120.0)
    result = through_moving(synthetic_packets(500.0, 0), setting, Stages("late-data", no_progress))
    rmse = result.rmse
    assert rmse["lag_10s"] <= rmse["lag_2s"] < rmse["rewound"] <= rmse["late_dropped"] < rmse["used_as_current"]
    assert rmse["no_delay"] < rmse["rewound"]
    for name, nees in result.nees.items():
        assert (abs(nees - 1) < 0.3) == (name != "used_as_current"), name
    assert result.counts["used"] > 150 and result.counts["duplicate"] > 0


@pytest.fixture(scope="module")
def mower():
    """A recorded drive; while this lives, all that is played to its network has its compiled programs."""
    with pytest.warns(UserWarning, match="predictions depend on when others are asked for"):
        _shared = Timeline(plaza.network(), 0.0)
    yield read_recording()


def test_the_mower_through_a_network(mower, tmp_path, fits):
    """The first 150 ranges; a network that delays nothing gives each method the same."""
    recording = mower.first(150)
    packets = synthetic_packets(1000.0, 0)
    at_once = Packets(packets.node, packets.sequence, packets.sent, packets.sent)
    late = through_plaza(recording, packets)
    ideal = through_plaza(recording, at_once, ("rewound", "no_delay", "late_dropped"))
    assert late.lost_ranges == ideal.lost_ranges > 0
    for there, here in ((late.through.rmse, ideal.through.rmse), (late.through.nees, ideal.through.nees)):
        assert here["rewound"] == here["no_delay"] == here["late_dropped"] == there["no_delay"]
    assert late.through.rmse["used_as_current"] > 2 * late.through.rmse["rewound"]
    outcome = Outcome(Trace(statistics(packets), None, True, 0), late.through, late)
    drawings = {name: svg(figure) for name, figure in figures(outcome).items()}
    page = example.make_page(Setting(), outcome, {}, drawings)
    (tmp_path / "report.html").write_text(page.html(), encoding="utf-8")
    fits(tmp_path / "report.html")
    titles = [section.title for section in page.sections]
    assert titles == ["A point that moves", "A recorded drive", "The network", "How to run this again"]


def test_the_whole_drive_is_what_readme_says(mower):
    """To its three digits, which another order of rounding does not reach."""
    known = "late_dropped", "rewound", "lag_2s"
    result = through_plaza(mower, synthetic_packets(Setting().network_s, 0), known).through
    dropped, rewound, later = (f"{result.rmse[name]:.3f} m" for name in known)
    row = f"| {dropped}: late ones dropped | {rewound}; {later} two seconds later | `heliograph example late-data --out"
    assert row in (Path(__file__).parents[2] / "README.md").read_text()
