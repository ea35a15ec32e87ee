"""`heliograph fit` learns from the rows that `heliograph run` filters: of dates, of steps, of copies."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.learning import fitting

SECONDS = """
import heliograph as hg
import jax.numpy as jnp

q = hg.free(1e-3, "q")
plant = hg.LinearPlant(
    lambda u: jnp.eye(1), lambda u: q * u[0] * jnp.eye(1), [20.0], 1.0, states=["x"], inputs=["dt"]
)
"""
STEPS = """
import heliograph as hg

plant = hg.LinearPlant([[1.0]], hg.free(1e-3, "q"), [20.0], 1.0, states=["x"])
"""
NODE = """
sensor = hg.LinearSensor([[1.0]], 0.04, outputs=["y"])
network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
field = hg.files.json_field
"""
VALUES = [20.1, 20.3, 20.2, 20.6, 20.5, 20.9, 21.1, 20.8, 20.7, 21.0, 21.4, 21.2]
MINUTES = [0, 5, 10, 15, 30, 31, 32, 33, 40, 45, 50, 55]
DATES = [f"2026-08-09T11:{m:02}:00Z" for m in MINUTES]


def rows(times, values=VALUES):
    """A table of time and y."""
    return "\n".join(["time,y", *(f"{t},{v}" for t, v in zip(times, values, strict=True)), ""])


def messages(times, numbers):
    """Lines of messages with a time and a count."""
    items = zip(times, VALUES, numbers, strict=True)
    return "".join(json.dumps({"node": "a", "time": t, "values": [v], "sequence": n}) + "\n" for t, v, n in items)


def retried(text):
    """The same lines, of which every second comes again two lines later."""
    lines = text.splitlines(keepends=True)
    return "".join(line + (lines[k - 2] if k >= 2 and k % 2 == 0 else "") for k, line in enumerate(lines))


SENT = messages(DATES, range(12))
CASES = {
    # name: (plant, file, text, seconds or steps of the rows, which of them have a value)
    "rows of dates": (SECONDS, "data.csv", rows(DATES), [np.datetime64(date[:-1]) for date in DATES]),
    "messages of dates": (SECONDS, "data.jsonl", SENT, [60 * m for m in MINUTES]),
    "messages that were retried": (SECONDS, "data.jsonl", retried(SENT), [60 * m for m in MINUTES]),
    "messages of steps": (STEPS, "data.jsonl", messages(range(0, 60, 5), range(12)), list(range(56))),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_fit_learns_from_the_rows_that_a_run_filters(name, tmp_path, monkeypatch, capsys):
    plant, file, text, times = CASES[name]
    (tmp_path / "net.py").write_text(plant + NODE)
    (tmp_path / file).write_text(text)
    monkeypatch.chdir(tmp_path)
    learned, filtered = [], []
    real_fit, real_run = fitting.fit, hg.run

    def learn(build, recording, **options):
        learned.append(recording)
        return real_fit(build, recording, **options)

    def filter(network, *recording, **options):
        filtered.append(hg.files.Recording(*recording))
        return real_run(network, *recording, **options)

    monkeypatch.setattr(fitting, "fit", learn)
    monkeypatch.setattr(hg, "run", filter)
    assert cli.main(["run", "net.py", "--measurements", file, "--out", "out.csv"]) == 0
    ran = capsys.readouterr().out
    arguments = ["--measurements", file, "--out", "out", "--starts", "1", "--held-out", "0"]
    assert cli.main(["fit", "net.py", *arguments]) == 0
    fitted = capsys.readouterr().out
    (one,), (other,) = learned, filtered
    np.testing.assert_array_equal(one.time, times)
    np.testing.assert_array_equal(one.time, other.time)
    np.testing.assert_array_equal(one.inputs, other.inputs)
    np.testing.assert_array_equal(one.measurements["a"], other.measurements["a"])
    np.testing.assert_array_equal(one.measurements["a"][~np.isnan(one.measurements["a"])], VALUES)
    said = [line for line in ran.splitlines() if line.startswith(("a:", "times"))]
    assert all(line in fitted for line in said)
