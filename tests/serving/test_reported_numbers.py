"""Services whose nodes are told numbers with each message: estimates as by `run`, also after a restart."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli, serving
from heliograph.model import told

PLANT = hg.LinearPlant([[0.95, 0.1], [0.0, 0.9]], 0.1 * np.eye(2), [0.5, 0.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 0.3]], 0.05, outputs=["y"])
LINK = told(lambda a: hg.hop(1.0, a[0]), ["variance"], typical=[0.1])
NETWORK = hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, {"f": hg.linear_filter(PLANT, SENSOR, LINK)})})
OPTIONS = serving.Options(window=3.0, step=1.0)
STEPS = 12


def rows():
    random = np.random.default_rng(0)
    z = np.column_stack([random.normal(size=STEPS), random.uniform(0.1, 1.0, STEPS)])
    z[4] = np.nan
    return z


def body(k, values):
    return json.dumps({"plant": "p", "node": "a", "sequence": k, "time": float(k), "values": list(values)}).encode()


def start(path):
    """A service on the store at a path, which an earlier one may have written."""
    fleet = serving.Fleet(serving.NetworkProgram(NETWORK), OPTIONS)
    return serving.Service(fleet, serving.Store(str(path), serving.identity(fleet)))


def estimates(outputs):
    """The last estimate of each time that was published."""
    told_of = [json.loads(output.body) for output in outputs]
    return {m["time"]: m["estimates"]["a"]["f"]["mean"] for m in told_of if "estimates" in m}


def test_a_service_uses_what_messages_tell_and_goes_on_after_a_restart(tmp_path):
    """Late by one message, one lost, and a restart in the middle: the filtered means of `run`, to rounding."""
    z, published = rows(), {}
    order = [0, 1, 3, 2, 5, 6, 8, 7, 9, 11, 10]
    for part in (order[:6], order[6:]):
        service = start(tmp_path / "store.db")
        for k in part:
            published |= estimates(service.take([body(k, z[k])]))
    expected = hg.run(NETWORK, {"a": z}).estimates["a"]["f"].mean
    np.testing.assert_allclose(published[float(STEPS - 1)], expected[-1], rtol=1e-12)


def test_a_message_that_tells_no_law_is_refused_alone(tmp_path):
    z, service = rows(), start(tmp_path / "store.db")
    service.take([body(0, z[0])])
    outputs = [json.loads(o.body) for o in service.take([body(1, [0.3, -1.0])])]
    assert any("implausible" in json.dumps(o) for o in outputs)
    after = estimates(service.take([body(2, z[2])]))
    given = np.full((3, 2), np.nan)
    given[0], given[2] = z[0], z[2]
    np.testing.assert_allclose(after[2.0], hg.run(NETWORK, {"a": given}).estimates["a"]["f"].mean[-1], rtol=1e-12)


NETWORK_FILE = """
import numpy as np
import pytest
import heliograph as hg
plant = hg.LinearPlant([[0.95, 0.1], [0.0, 0.9]], 0.1 * np.eye(2), [0.5, 0.0], np.eye(2))
sensor = hg.LinearSensor([[1.0, 0.3]], 0.05, outputs=["y"])
link = hg.model.told(lambda a: hg.hop(1.0, a[0]), ["variance"], typical=[0.1])
network = hg.Network(plant, {"a": hg.Node(sensor, link, {"f": hg.linear_filter(plant, sensor, link)})})
"""


@pytest.mark.slow
def test_a_replayed_table_says_what_was_told(tmp_path, monkeypatch, capsys):
    """Columns of the values and of what was told with them: the messages of a replay, a service, and `run` agree."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text(NETWORK_FILE)
    z = rows()
    lines = [f"{k}," + ",".join("" if np.isnan(v) else repr(float(v)) for v in row) for k, row in enumerate(z)]
    (tmp_path / "data.csv").write_text("time,y,variance\n" + "\n".join(lines) + "\n")
    assert cli.main(["replay", "data.csv", "--network", "net.py", "--plant", "p"]) == 0
    messages = capsys.readouterr().out.splitlines()
    assert len(messages) == STEPS - 1  # nothing came in one row
    assert json.loads(messages[0])["values"] == z[0].tolist()
    service, published = start(tmp_path / "store.db"), {}
    for message in messages:
        published |= estimates(service.take([message.encode()]))
    expected = hg.run(NETWORK, {"a": z}).estimates["a"]["f"].mean
    np.testing.assert_allclose(published[float(STEPS - 1)], expected[-1], rtol=1e-12)
    assert cli.main(["run", "net.py", "--measurements", "data.csv", "--out", "run.csv", "--smooth", "all"]) == 0
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True, deletechars="")
    names = [name for name in table.dtype.names if name.endswith("x0") and "cov" not in name]
    smoothed = hg.run(NETWORK, {"a": z}, smooth=hg.smoothing.FixedInterval()).smoothed.estimates["a"]["f"]
    np.testing.assert_allclose(table[names[0]], expected[:, 0], rtol=1e-12)
    np.testing.assert_allclose(table[names[1]], smoothed.mean[:, 0], rtol=1e-12)
