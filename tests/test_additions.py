"""Each kind of addition, made in a copy of the library: the files that CONTRIBUTING lists are all that it touches."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import heliograph

SOURCE = Path(heliograph.__file__).parent
PAGE = SOURCE.parents[1] / "CONTRIBUTING.md"

LAW = {
    "random_affine/laws/fading.py": ("", '''

class Weibull(AbstractLaw):
    """Weibull fading, g = scale (-log u)^(1/shape) with u uniform."""

    scale: Scalar
    shape: Scalar

    def sample(self, key: jax.Array) -> jax.Array:
        return self.scale * jax.random.exponential(key, dtype=float) ** (1 / self.shape)

    def moment(self, order: int) -> float | jax.Array:
        gammaln = scipy_for(self.shape).special.gammaln
        return self.scale**order * library(self.shape).exp(gammaln(1 + order / self.shape))
'''),
    "random_affine/__init__.pyi": ("    Rician as Rician,\n", "    Weibull as Weibull,\n"),
}  # fmt: skip

FILTER = {
    "filters/NAME.py": ("", '''"""Filter with a gain that is chosen once and for all."""

import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns, columns_of, join_columns
from heliograph.factors.factored_gaussian import from_columns, from_covariance, predict_affine
from heliograph.filters.base import AbstractSizedFilter, corrects, make_sizes, predicts
from heliograph.filters.innovation import gaussian_innovation
from heliograph.model.estimate import Estimate
from heliograph.numerics.float64 import in_float64


class FixedGainFilter(AbstractSizedFilter):
    """Filter xhat = A xhat + K (z - C A xhat), whose covariance is exact for any K."""

    plant: object
    sensor: object
    gain: object

    @in_float64
    def init(self):
        return from_covariance(self.plant.initial_mean, self.plant.initial_covariance)

    @predicts
    def predict(self, state, u=(), k=0):
        u = jnp.asarray(u)
        noise = columns_of(self.plant.noise_covariance(u))
        return predict_affine(state, self.plant.transition_matrix(u), self.plant.shift(u), noise)

    @corrects
    def correct(self, state, z, k=0):
        z, c, noise = jnp.asarray(z), jnp.asarray(self.sensor.matrix), self.sensor.noise.columns
        gain, expected = jnp.where(jnp.isnan(z), 0.0, self.gain), c @ state.mean
        mean = state.mean + gain @ jnp.where(jnp.isnan(z), 0.0, z - expected)
        kept = WeightedColumns(state.root - gain @ c @ state.root, state.variances)
        total = join_columns(WeightedColumns(c @ state.root, state.variances), noise).covariance
        after = from_columns(mean, join_columns(kept, noise.through(gain)))
        return after, gaussian_innovation(z, expected, total)

    def estimate(self, state):
        return Estimate(state.mean, state.covariance, self.claim)


def fixed_gain_filter(plant, sensor, gain):
    """Filter with a gain that is given."""
    return FixedGainFilter(plant=plant, sensor=sensor, gain=gain, **make_sizes("exact", plant, len(sensor.outputs)))
'''),
    "filters/__init__.pyi": ("", "\nfrom .NAME import fixed_gain_filter as fixed_gain_filter\n"),
}  # fmt: skip

CHANNEL = {
    "random_affine/NAME.py": ("", '''"""Rotation of two components by an angle uniform over a range."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import known
from heliograph.random_affine.moments.monomials import JointMoments

NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)


class Turned(AbstractRandomAffine):
    """Map z = R(a) y, a uniform on (-widest, widest)."""

    widest: float

    @property
    def outputs(self):
        return 2

    @property
    def inputs(self):
        return 2

    def sample(self, key):
        a = jax.random.uniform(key, minval=-1.0, maxval=1.0, dtype=float) * self.widest
        return jnp.array([[jnp.cos(a), -jnp.sin(a), 0.0], [jnp.sin(a), jnp.cos(a), 0.0], [0.0, 0.0, 1.0]])

    def moments(self, order):
        turns = [known([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in NODES * self.widest]
        matrices = np.array([turn.moments(order).matrix for turn in turns])
        return JointMoments(np.tensordot(WEIGHTS / 2, matrices, axes=1), 2, 2, order)

    def mean_gain(self):
        return known(np.sinc(self.widest / np.pi) * np.eye(2))

    def visit_hops(self, visit, position):
        return self, position  # nothing transmits

    def in_words(self):
        return "turned"
'''),
    "random_affine/__init__.pyi": ("", "\nfrom .NAME import Turned as Turned\n"),
}  # fmt: skip

RULE = {
    "fusion/rules.py": ("", '''

class FirstOnly(AbstractFusion):
    """The estimate of the first node, whatever the others say."""

    def claim(self, claims):
        return claims[0]

    def combine(self, means, covariances):
        return means[0], covariances[0]
'''),
    "fusion/__init__.pyi": ("", "\nfrom .rules import FirstOnly as FirstOnly\n"),
}  # fmt: skip

WORLD = """
import jax
import numpy as np
import heliograph as hg
from heliograph.testing import check_filter, check_fusion, check_random_affine
plant = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1 * np.eye(2), [1.0, 2.0], np.eye(2))
sensor = hg.LinearSensor(np.eye(2), 0.1 * np.eye(2))
def simulated(channel, filter):
    network = hg.Network(plant, {"a": hg.Node(sensor, channel, {"f": filter})})
    nees, low, high = hg.monte_carlo(network, 8, 400, 0, keep=hg.Statistics())["a"]["f"].nees_per_dimension()
    assert low < 1 < high, (nees, low, high)  # the claim is exact; the seed is fixed
    return network
def behind(channel):
    check_random_affine(channel, highest=2)
    network = simulated(channel, hg.linear_filter(plant, sensor, channel))
    hg.Stream(hg.linear_filter(plant, sensor, channel)).push([0.1, 0.2])
    return network, hg.power(network, 5).over_time
"""
TRIALS = """
import json, sys, traceback
outcomes = {}
for kind, trial in json.loads(sys.argv[1]).items():
    try:
        exec(trial, dict(globals()))
        outcomes[kind] = "done"
    except Exception:
        outcomes[kind] = traceback.format_exc()
print(json.dumps(outcomes))
"""
KINDS = {
    "a law": (LAW, "behind(hg.hop(hg.random_affine.Weibull(1.0, 2.5), 0.05, dimension=2))\n"
                   "jax.grad(lambda shape: hg.random_affine.Weibull(1.0, shape).moment(2))(2.5)  # as fits do"),
    "a filter": (FILTER, "f = hg.filters.fixed_gain_filter(plant, sensor, 0.3 * np.eye(2)); check_filter(f)\n"
                         "simulated(hg.perfect(2), f)"),
    "a channel": (CHANNEL, "network, sent = behind(hg.random_affine.Series([hg.random_affine.Turned(0.7), "
                           "hg.hop(1.0, 0.1, dimension=2)]))\n"
                           "assert list(sent) == ['a.hop1'] and 'turned' in repr(network)"),
    "a rule of fusion": (RULE, "check_fusion(hg.fusion.FirstOnly())"),
}  # fmt: skip


def listed() -> dict[str, tuple[list[str], int]]:
    """Files of the library and the greatest number of them, by addition."""
    section = PAGE.read_text().split("\n## What an addition touches")[1].split("\n## ")[0]
    rows = [row.strip("|").split(" | ") for row in section.splitlines() if row.startswith("| a")]
    return {
        row[0].strip(): (re.findall(r"`([\w/]+\.pyi?)`", row[1]), int(row[2]))
        for row in rows
        if row[2].strip().isdigit()
    }


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory) -> dict[str, str]:
    """What came of each addition; all are made in one copy."""
    copy = tmp_path_factory.mktemp("added") / "heliograph"
    shutil.copytree(SOURCE, copy)  # with what Python has compiled, which it knows by the sources' times
    for kind, (changes, _) in KINDS.items():
        for name, (anchor, text) in changes.items():
            path, made = copy / name.replace("NAME", made_by(kind)), text.replace("NAME", made_by(kind))
            before = path.read_text() if path.exists() else ""
            assert before.count(anchor) == 1 or not anchor
            at = before.index(anchor) + len(anchor) if anchor else len(before)
            path.write_text(before[:at] + made + before[at:])
    trials = {kind: trial for kind, (_, trial) in KINDS.items()}
    places = os.pathsep.join([str(copy.parent), str(SOURCE.parent)])  # the second for what is beside the library
    done = subprocess.run(
        [sys.executable, "-c", WORLD + TRIALS, json.dumps(trials)],
        env=os.environ | {"PYTHONPATH": places, "JAX_PLATFORMS": "cpu"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    result: dict[str, str] = json.loads(done.stdout)
    return result


def made_by(kind: str) -> str:
    """Name of the file that an addition makes."""
    return kind.replace(" ", "_")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_an_addition_touches_no_more_files_than_listed(kind, outcomes):
    """What was added does what the library promises of it."""
    files, most = listed()[kind]
    assert sorted(KINDS[kind][0]) == sorted(files) and len(files) <= most
    assert outcomes[kind] == "done"


def test_no_addition_needs_a_file_of_another():
    """Else it would work where it alone is made no more: only lists of names are shared."""
    changed = [name for changes, _ in KINDS.values() for name in changes if "NAME" not in name]
    assert {name for name in changed if changed.count(name) > 1} == {"random_affine/__init__.pyi"}


def test_what_an_addition_touches_is_there():
    rows = listed()
    assert set(KINDS) <= set(rows)
    for kind, (files, most) in rows.items():
        gone = [name for name in files if "NAME" not in name and not (SOURCE / name).exists()]
        assert not gone and 0 < len(files) <= most, kind


def test_a_file_has_room_for_what_is_added_to_it():
    """It stays within the 400 lines that a file may have."""
    for changes, _ in KINDS.values():
        for name, (_, text) in changes.items():
            if (SOURCE / name).exists():
                assert len((SOURCE / name).read_text().splitlines()) + text.count("\n") <= 400, name
