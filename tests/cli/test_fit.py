"""`heliograph fit` on one recording: what it writes, and that what it writes runs."""

import json
import shutil

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.files.fitted import load_fitted
from heliograph.files.recordings.recording import Recording, write_recording

SOURCE = """
import numpy as np
import heliograph as hg

plant = hg.LinearPlant([[0.95]], hg.free({plant}, "plant noise"), [0.0], 1.0)
sensor = hg.LinearSensor([[1.0]], 0.05, outputs=["far"])
channel = hg.hop(1.0, noise=hg.free({hop}, "hop noise"))
filters = {{"aware": hg.linear_filter(plant, sensor, channel)}}
network = hg.Network(plant, {{"a": hg.Node(sensor, hg.erasure(channel, 0.9), filters)}})
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A network file, and what it measured with other numbers.

    The network lies in a folder whose name the file that the command writes has to quote.
    """
    place = tmp_path_factory.mktemp("fit") / 'it\'s a {"place"}'
    place.mkdir()
    (place / "cart.py").write_text(SOURCE.format(plant=1.0, hop=1.0))
    (place / "truth.py").write_text(SOURCE.format(plant=0.2, hop=0.5))
    network = hg.files.load_network(str(place / "truth.py"))
    z = hg.monte_carlo(network, horizon=600, runs=1, key=1).measurements["a"][0]
    write_recording(Recording({"a": z}, np.zeros((600, 0)), np.arange(600.0)), network, place / "data.csv")
    return place


@pytest.fixture(scope="module")
def folder(recorded):
    """The same, and what the command found there."""
    files = ["--measurements", str(recorded / "data.csv"), "--out", str(recorded / "out")]
    assert cli.main(["fit", str(recorded / "cart.py"), *files, "--starts", "2"]) == 0
    return recorded


@pytest.mark.slow
def test_the_numbers_are_found_with_their_intervals(folder):
    content = json.loads((folder / "out" / "fitted.json").read_text())
    rows = {row["name"]: row for row in content["table"]}
    for name, truth in {"plant noise": 0.2, "hop noise": 0.5}.items():
        assert rows[name]["low"] < truth < rows[name]["high"]
        assert content["values"][name] == rows[name]["estimate"]
    assert content["rows"] == 450 and content["converged"] and not content["stopped"]


@pytest.mark.slow
def test_the_fitted_network_runs_where_the_folders_are_moved_together(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "moved")
    out = tmp_path / "estimates.csv"
    code = cli.main(["run", str(tmp_path / "moved" / "out" / "fitted_network.py"), "--measurements",
                 str(folder / "data.csv"), "--out", str(out)])  # fmt: skip
    assert code == 0 and out.is_file()


@pytest.mark.slow
def test_a_share_of_rows_is_of_the_decimal_that_is_typed(recorded, tmp_path):
    """29 of 100: the nearest double of 0.29 times 100 is 28.999999999999996."""
    lines = (recorded / "data.csv").read_text().splitlines()
    (tmp_path / "data.csv").write_text("\n".join(lines[:101]))
    command = ["fit", str(recorded / "cart.py"), "--measurements", str(tmp_path / "data.csv"), "--held-out", "0.29"]
    assert cli.main([*command, "--out", str(tmp_path / "out"), "--starts", "1"]) == 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["held_out_rows"] == 29


@pytest.mark.slow
def test_the_filter_is_better_on_rows_it_has_not_seen(folder):
    """By the difference of the log-likelihoods of both filters over the last 150 rows, computed another way."""
    summary = json.loads((folder / "out" / "summary.json").read_text())
    (item,) = summary["filters"]
    assert summary["held_out_rows"] == 150
    assert item["gain"] > 2 * item["gain_error"]
    assert abs(item["size_after"] - 1) < abs(item["size_before"] - 1)
    before = hg.files.load_network(str(folder / "cart.py"))
    after = hg.files.load_network(str(folder / "out" / "fitted_network.py"))
    z = hg.files.read_recording(folder / "data.csv", before).measurements["a"]
    whole, early = (
        [hg.log_likelihood(n.nodes["a"].filters["aware"], part) for n in (before, after)] for part in (z, z[:450])
    )
    received = np.count_nonzero(~np.isnan(z[450:]))
    gain = (whole[1] - early[1] - whole[0] + early[0]) / received
    assert item["gain"] == pytest.approx(gain, rel=1e-9)


@pytest.mark.slow
def test_the_page_says_what_was_learned(folder, fits):
    fits(folder / "out" / "report.html")
    page = (folder / "out" / "report.html").read_text()
    for words in ("hop noise", "plant noise", "Before and after", "Do the laws fit", "fitted_network.py"):
        assert words in page
    for name in ("estimates", "innovations", "pits"):
        assert (folder / "out" / f"{name}.png").stat().st_size > 5000


@pytest.mark.slow
def test_the_losses_of_the_recording_are_informed(folder):
    """A tenth of the rows was lost, independently: the interval holds that, and the test finds no memory."""
    (losses,) = json.loads((folder / "out" / "summary.json").read_text())["losses"].values()
    share = losses["laws"]["independent"]["loss"]
    assert share["low"] < 0.1 < share["high"] and share["estimate"] == losses["lost"] / 600
    assert losses["memory_p"] > 0.01
    assert "How measurements are lost" in (folder / "out" / "report.html").read_text()


def test_other_numbers_are_refused(recorded, tmp_path):
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"values": {"plant noise": 0.1}}))
    with pytest.raises(ValueError, match="expected those that are free in the network"):
        load_fitted(recorded / "cart.py", other)
    other.write_text("[]")
    with pytest.raises(ValueError, match="expected a file that `heliograph fit` wrote"):
        load_fitted(recorded / "cart.py", other)


def test_a_network_in_which_nothing_is_free_is_informed(recorded, tmp_path, capsys):
    path = tmp_path / "still.py"
    path.write_text(SOURCE.format(plant=1.0, hop=1.0).replace("hg.free(1.0, ", "(lambda x, y: x)(1.0, "))
    out = str(tmp_path / "out")
    assert cli.main(["fit", str(path), "--measurements", str(recorded / "data.csv"), "--out", out]) == 2
    assert "expected at least one number marked by hg.free" in capsys.readouterr().err
    assert cli.main(["fit", str(path), "--measurements", "none.csv", "--out", out, "--held-out", "1"]) == 2
    assert "--held-out: expected a number from 0 to 0.9, got 1" in capsys.readouterr().err


@pytest.mark.slow
def test_a_sender_that_decides_is_refused_with_what_learns_it(tmp_path, capsys):
    """What the line says is done: noise of 1, of 60 rows of which some are silent."""
    path, true, data = tmp_path / "event.py", tmp_path / "true.py", tmp_path / "data.csv"
    true.write_text(
        "import heliograph as hg\n"
        "plant = hg.LinearPlant([[0.9]], hg.free(1.0, 'plant noise'), [0.0], 1.0)\n"
        "sensor = hg.LinearSensor([[1.0]], 0.05, outputs=['level'])\n"
        "node = hg.Node(sensor, hg.perfect(), {}, trigger=hg.SendOnDelta(0.5))\n"
        "network = hg.Network(plant, {'a': node})\n"
    )
    path.write_text(true.read_text().replace("free(1.0", "free(0.3"))
    network = hg.files.load_network(str(true))
    z = hg.monte_carlo(network, horizon=60, runs=1, key=1).measurements["a"][0]
    write_recording(Recording({"a": z}, np.zeros((60, 0)), np.arange(60.0)), network, data)
    assert cli.main(["fit", str(path), "--measurements", str(data), "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err.strip()
    assert line.endswith(
        "network to be learned: expected no trigger of a node "
        "(in Python hg.fit(hg.files.fitted.NetworkAgain(FILE), recording) learns it), got one with a trigger"
    )
    recording = hg.files.read_recording(data, network)
    found = hg.fit(hg.files.fitted.NetworkAgain(str(path)), recording, starts=1)
    (row,) = found.rows()
    assert found.converged and row.low < 1.0 < row.high


@pytest.mark.slow
def test_an_interrupted_search_keeps_the_best_so_far(recorded, tmp_path, monkeypatch):
    """The interrupt comes at the third look at how far the search has come."""
    from heliograph.learning import fitting

    seen = []

    def interrupted(progress):
        def say(line):
            seen.append(line)
            if len(seen) == 3:
                raise KeyboardInterrupt
            progress(line)

        return say

    real = fitting.fit
    monkeypatch.setattr(fitting, "fit", lambda *a, progress, **k: real(*a, progress=interrupted(progress), **k))
    out = tmp_path / "out"
    command = ["fit", str(recorded / "cart.py"), "--measurements", str(recorded / "data.csv"), "--out", str(out)]
    assert cli.main([*command, "--starts", "2"]) == 0  # the command itself was not interrupted
    content = json.loads((out / "fitted.json").read_text())
    assert content["stopped"] and "best so far" in content["sentences"][0]
    assert np.isfinite(list(content["values"].values())).all()


@pytest.mark.slow
def test_the_truth_is_learned_from_where_the_table_has_it(recorded, tmp_path, capsys):
    command = [
        "fit",
        str(recorded / "cart.py"),
        "--truth",
        "--starts",
        "1",
        "--out",
        str(tmp_path / "out"),
        "--measurements",
    ]
    assert cli.main([*command, str(recorded / "data.csv")]) == 2
    expected = (
        f"heliograph: {recorded / 'data.csv'}: expected columns of the true states, truth.STATE, for --truth, got none"
    )
    assert capsys.readouterr().err.endswith(f"{expected}\n")
    table = (recorded / "data.csv").read_text().splitlines()
    rows = [f"{row},{row.split(',')[1]}" for row in table[1:60]]
    (tmp_path / "true.csv").write_text("\n".join([f"{table[0]},truth.x0", *rows]))
    assert cli.main([*command, str(tmp_path / "true.csv")]) == 0
    forms = {row["form"] for row in json.loads((tmp_path / "out" / "fitted.json").read_text())["table"]}
    assert forms == {"truth"}


RATES = """
import heliograph as hg

plant = hg.LinearPlant([[0.98]], hg.free(0.1, "q"), [0.0], 1.0, states=["x"])
sensors = {name: hg.LinearSensor([[1.0]], 0.1, outputs=[f"{name} y"]) for name in ("fast", "odom")}
nodes = {name: hg.Node(s, hg.perfect(), {"k": hg.kalman_filter(plant, s)}) for name, s in sensors.items()}
network = hg.Network(plant, nodes)
"""


@pytest.mark.slow
def test_a_slower_sender_loses_what_was_due_and_did_not_come(tmp_path):
    """A sender that is due in each fourth row loses 3 of the 148 between its ends, not three quarters of the rows."""
    (tmp_path / "net.py").write_text(RATES)
    rng = np.random.default_rng(1)
    x = np.cumsum(0.1 * rng.standard_normal(600))
    rows = [f"{k / 10},{x[k] + rng.normal()},{x[k] + rng.normal() if k % 4 == 0 and k not in (100, 200, 204) else ''}"
            for k in range(600)]  # fmt: skip
    (tmp_path / "data.csv").write_text("\n".join(["time,fast y,odom y", *rows]))
    arguments = ["--measurements", str(tmp_path / "data.csv"), "--out", str(tmp_path / "out"), "--starts", "1"]
    assert cli.main(["fit", str(tmp_path / "net.py"), *arguments]) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert f"loss {3 / 148:.3g} " in page and "fast</" not in page[page.index("How measurements are lost") :]


@pytest.mark.filterwarnings("default")
def test_readings_that_a_node_refuses_are_neither_learned_from_nor_judged_by(recorded, tmp_path, capsys):
    """A code of -999 in a learned row and in a held-out one was a measurement of the fit and of its comparison."""
    network = (recorded / "cart.py").read_text()
    (tmp_path / "plain.py").write_text(network)
    (tmp_path / "codes.py").write_text(network.replace("0.9), filters)", "0.9), filters, invalid=-999)"))
    lines = (recorded / "data.csv").read_text().splitlines()[:121]
    place = lines[0].split(",").index("far")
    for value, name in (("", "plain"), ("-999", "codes")):
        rows = [line.split(",") for line in lines]
        rows[20][place] = rows[110][place] = value
        (tmp_path / f"{name}.csv").write_text("\n".join(",".join(row) for row in rows))

    def fit(name):
        command = ["fit", str(tmp_path / f"{name}.py"), "--measurements", str(tmp_path / f"{name}.csv")]
        assert cli.main([*command, "--out", str(tmp_path / name), "--starts", "1"]) == 0
        return json.loads((tmp_path / name / "fitted.json").read_text())["values"]

    assert fit("codes") == fit("plain")
    said = capsys.readouterr().err
    assert said.count("2 of 110 values count as not arrived, by code; row 20: far -999 is a code") == 1
