"""A store whose network has changed goes on with what fits, says what changed, and begins only the rest anew."""

import json
from pathlib import Path

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.live.stored import PlantMigration, unpack_plant
from heliograph.serving.service import Service
from heliograph.serving.storage import Store, identity
from tests.serving.worlds import fleet as world
from tests.serving.worlds import lines as written
from tests.serving.worlds import messages as messages_of
from tests.serving.worlds import moving

WINDOW = 5.0


def network(noise: float = 0.04, names: str = "ab", states: tuple[str, ...] = ("level",)) -> hg.Network:
    plant = hg.LinearPlant([[0.95]], noise, [1.0], 0.5, [[1.0]], inputs=["push"], states=states)
    sensor, hop = hg.LinearSensor([[1.0]], 0.1), hg.hop(hg.Discrete([0.6, 1.2], [0.5, 0.5]), 0.05)
    nodes = {name: hg.Node(sensor, hop, {"f": hg.linear_filter(plant, sensor, hop)}) for name in names}
    return hg.Network(plant, nodes)


def fleet(item: hg.Network, window: float = WINDOW) -> Fleet:
    return Fleet(NetworkProgram(item), Options(window))


def sent(begin: int, end: int, names: str = "ab") -> list[bytes]:
    """Messages of the steps from begin to end, each with its value."""
    rows = [
        {"plant": "p", "node": node, "sequence": k, "time": k, "values": [float(np.sin(k) + 0.1 * i)], "arrival": k}
        for k in range(begin, end)
        for i, node in enumerate(names)
    ]
    return [json.dumps(row).encode() for row in rows]


def stored(place: Path, item: hg.Network, count: int = 20, names: str = "ab") -> str:
    store = Store(str(place), identity(fleet(item)))
    Service(fleet(item), store).take(sent(0, count, names))
    store.close()
    return str(place)


def finals(service: Service, messages: list[bytes]) -> dict[float, dict]:
    known = [json.loads(output.body) for output in service.take(messages)]
    return {output["time"]: output["estimates"] for output in known if output["kind"] == "final"}


def carried(place: str, item: hg.Network, window: float = WINDOW) -> tuple[Service, list[str]]:
    lines: list[str] = []
    new = fleet(item, window)
    store = Store(place, identity(new), carrier=PlantMigration(new, identity(new), lines.append))
    return Service(new, store), lines


def base(place: str, item: hg.Network) -> np.ndarray:
    """State of the filters after the base row of the stored plant, by leaf: (mean, covariance, moments of x) x node."""
    here = fleet(item)
    store = Store(place, identity(here))
    plant = unpack_plant("p", store.load(["p"])["p"].body, here)
    store.close()
    return here.state_table.table[plant.rows.held[0].slot, here.state_table.state].reshape(4, -1)


@pytest.mark.slow
def test_another_noise_goes_on_from_the_state_that_was_and_is_named(tmp_path):
    place = stored(tmp_path / "a.db", network())
    mean, variance, level, spread = base(place, network())[:, 0]
    with pytest.raises(ValueError, match="--accept-changes goes on with what fits"):
        Store(place, identity(fleet(network(0.09))))
    service, lines = carried(place, network(0.09))
    assert any("plant.noise.covariance: 0.04 -> 0.09" in line for line in lines)
    assert not any("begins with" in line or "option" in line for line in lines)
    # The best linear filter by hand from the base, step 13, with the new noise: z = g y + n, E g = 0.9, Var g = 0.09.
    known = finals(service, sent(20, 24))
    assert list(known) == [14.0, 15.0, 16.0, 17.0]
    for k, estimates in known.items():
        mean, level = 0.95 * mean, 0.95 * level
        variance, spread = (0.95**2 * x + 0.09 for x in (variance, spread))
        innovation = 0.81 * (variance + 0.1) + 0.09 * (spread + level**2 + 0.1) + 0.05
        gain = 0.9 * variance / innovation
        mean, variance = mean + gain * (np.sin(k) - 0.9 * mean), variance - gain**2 * innovation
        item = estimates["a"]["f"]
        assert np.allclose([item["mean"][0], item["covariance"][0][0]], [mean, variance], rtol=1e-12)
    service.store.close()
    Store(place, identity(fleet(network(0.09)))).close()  # it is the store of the new network now


@pytest.mark.slow
def test_a_new_sensor_begins_alone_and_one_that_left_goes_alone(tmp_path):
    """The nodes' order changes too: b was second of (a, b), is last of (c, b), and of (b, a)."""
    calm = Service(fleet(network()), Store(str(tmp_path / "calm.db"), identity(fleet(network()))))
    calm.take(sent(0, 20))
    expected = finals(calm, sent(20, 24))
    calm.store.close()
    for names, new in (("cab", {"c/f"}), ("cb", {"c/f"}), ("ba", set())):
        service, lines = carried(stored(tmp_path / f"{names}.db", network()), network(names=names))
        begun = {line.split(": ")[1].split(" begins")[0] for line in lines if "begins with the initial law" in line}
        assert begun == new
        known = finals(service, sent(20, 24) if "a" in names else only_b())
        assert list(known) == [14.0, 15.0, 16.0, 17.0]
        for time, estimates in known.items():
            for node in set(names) & set("ab"):
                got, right = (np.array(item[time][node]["f"]["mean"]) for item in (known, expected))
                assert np.allclose(got, right, rtol=1e-12)  # one program for three nodes, another for two
            assert set(estimates) == set(names)
        service.store.close()


def only_b() -> list[bytes]:
    return [line for line in sent(20, 24) if b'"node": "b"' in line]


def test_an_option_alone_changes_no_bit_of_what_follows(tmp_path):
    item = network()
    calm = Service(fleet(item), Store(str(tmp_path / "calm.db"), identity(fleet(item))))
    calm.take(sent(0, 20))
    service, lines = carried(stored(tmp_path / "a.db", item), item, window=3.0)
    assert [line.split(": ", 1)[1] for line in lines] == ["option window: 5.0 -> 3.0"]
    expected, known = finals(calm, sent(20, 30)), finals(service, sent(20, 30))
    assert set(expected) < set(known) and all(known[time] == expected[time] for time in expected)
    for running in (calm, service):
        running.store.close()


def test_a_snapshot_is_carried_over_and_stays_as_it_is(tmp_path):
    place, new = stored(tmp_path / "a.db", network()), fleet(network(0.09))
    lines: list[str] = []
    store = Store(str(tmp_path / "b.db"), identity(new))
    store.begin_from(place, identity(new), PlantMigration(new, identity(new), lines.append))
    known = finals(Service(new, store), sent(20, 24))
    service, other = carried(place, network(0.09))
    assert known == finals(service, sent(20, 24)) and lines == other
    for opened in (store, service.store):
        opened.close()


@pytest.mark.slow
def test_what_cannot_be_carried_over_is_refused_and_nothing_is_changed(tmp_path):
    place = stored(tmp_path / "a.db", network())
    with pytest.raises(ValueError, match=r"expected the states that are stored, 'level', .*, got 'height'"):
        carried(place, network(states=("height",)))
    Store(place, identity(fleet(network()))).close()


@pytest.mark.slow
def test_rows_of_single_events_and_inputs_in_continuous_time_are_carried_over(tmp_path):
    """Each event has a row of its own there, whose key has the place of its node."""
    item = moving()
    messages = written(messages_of(2, 30, seed=3, whole=False))
    results = []
    for accepts in (False, True):
        place, here = str(tmp_path / f"{accepts}.db"), world(item)
        store = Store(place, identity(here))
        service = Service(here, store)
        service.take(messages[:40])
        if accepts:
            store.close()
            here = world(item, window=4.0)
            said: list[str] = []
            store = Store(place, identity(here), carrier=PlantMigration(here, identity(here), said.append))
            service = Service(here, store)
            assert [line.split(": ", 1)[1] for line in said] == ["option window: 5.0 -> 4.0"]
        known = [json.loads(output.body) for output in service.take(messages[40:])]
        results.append({(o["plant"], o["time"]): o["estimates"] for o in known if o["kind"] == "final"})
        store.close()
    assert set(results[0]) < set(results[1]) and len(results[0]) > 10
    assert all(results[1][key] == estimates for key, estimates in results[0].items())
