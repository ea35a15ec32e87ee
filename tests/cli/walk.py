"""A temperature that walks, `heliograph run` on its messages, and its estimates by hand."""

import numpy as np

import heliograph as hg
from heliograph import cli

WALK = """
import heliograph as hg
import jax.numpy as jnp

plant = hg.LinearPlant(
    lambda u: jnp.eye(1), lambda u: 1e-4 * u[0] * jnp.eye(1), [20.0], 1.0, states=["x"], inputs=["dt"]
)
sensor = hg.LinearSensor([[1.0]], 0.04, outputs=["y"])
network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
field = hg.files.json_field
"""


def run(folder, capsys, name, text, sources="{}", *options):
    """Standard output and error of `heliograph run`, and its table; None where it refuses."""
    (folder / "net.py").write_text(f"{WALK}\nsources = {sources}\n")
    (folder / name).write_text(text)
    (folder / "out.csv").unlink(missing_ok=True)
    code = cli.main(["run", "net.py", "--measurements", name, "--out", "out.csv", *options])
    said = capsys.readouterr()
    assert code == (0 if (folder / "out.csv").exists() else 2), said.err
    return said.out, said.err, hg.files.read_table("out.csv") if code == 0 else None


def kalman(times, values):
    """The last mean and deviation of the walk's filter, by hand."""
    m, p, before = 20.0, 1.0, times[0]
    for t, y in zip(times, values, strict=True):
        p, before = p + 1e-4 * (t - before), t
        gain = 0.0 if np.isnan(y) else p / (p + 0.04)
        y = m if np.isnan(y) else y  # did not arrive
        m, p = m + gain * (y - m), p - gain * p
    return m, np.sqrt(p)


def agrees(table, times, values):
    """Up to rounding."""
    assert len(table["x"]) == len(times)
    np.testing.assert_allclose([table["x"][-1], table["x.sd"][-1]], kalman(times, values), rtol=1e-12)
