"""Names with units are the names themselves wherever only the name counts."""

import copy
import pickle

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.files.recordings.recording import read_recording


def unit_of(name):
    """The unit of a name of a state, output or input; none of plain text."""
    return getattr(name, "unit", "")


def plant(states: object) -> hg.LinearPlant:
    return hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, states=states)


def test_a_name_with_a_unit_is_the_name():
    (name,) = plant({"position": "m"}).states
    assert name == "position" and hash(name) == hash("position") and {"position": 1}[name] == 1
    for same in (pickle.loads(pickle.dumps(name)), copy.deepcopy(name)):
        assert (same, unit_of(same)) == ("position", "m")
    assert unit_of("position") == ""


def test_compiled_structures_do_not_change():
    assert jax.tree.structure(plant({"position": "m"})) == jax.tree.structure(plant(["position"]))


def test_units_are_in_records_columns_and_files(tmp_path):
    item = plant({"position": "m"})
    sensor = hg.LinearSensor([[1.0]], 0.1, outputs={"range": "m"})
    network = hg.Network(item, {"a": hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(item, sensor)})})
    table = {"time": np.arange(3.0), "range (m)": np.array([1.0, 2.0, 3.0]), "truth.position (m)": np.zeros(3)}
    recording = read_recording(table, network)
    assert recording.measurements["a"][:, 0].tolist() == [1.0, 2.0, 3.0] and recording.truth is not None
    record = hg.run(network, *recording)
    assert record.units == {"position": "m"} and record.with_units({"position": "cm"}).units == {"position": "cm"}
    hg.files.write_estimates(record, tmp_path / "estimates.csv")
    assert {"position (m)", "position.sd (m)"} <= set(hg.files.read_table(tmp_path / "estimates.csv"))
    statistics = hg.monte_carlo(network, 3, runs=2, key=0, keep=hg.Statistics())
    assert statistics.units == {"position": "m"}


def test_a_unit_that_is_no_text_is_refused_in_one_line():
    with pytest.raises(ValueError, match="state names, unit of 'position': expected a text, got 3"):
        plant({"position": 3})
    with pytest.raises(ValueError, match="1 distinct names"):
        plant({"position": "m", "speed": "m/s"})


@pytest.mark.parametrize("names", [[""], [" "], {"": "m"}])
def test_a_blank_name_is_refused_in_one_line(names):
    """A column without a name could not be read back."""
    with pytest.raises(ValueError, match="expected names that are not blank"):
        hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, states=names)
