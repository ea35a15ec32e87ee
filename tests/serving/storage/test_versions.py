"""A store that an older version wrote is named, and read where the user says so: estimates go on as there.

In `tests/version_0_2` is `store.sql.gz`, what version 0.2.0 wrote, as SQL, and `finals.jsonl`, the final estimates with
which that version itself went on (14 digits): `heliograph serve network.py --window 2 --store store.db` with
`sent(0, 6)`, then with `sent(6, 9)`. Its states held covariances, its description the flags `.moved` in column 1.
"""

import gzip
import json
import math
import runpy
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.live.stored import PlantMigration
from heliograph.serving.service import Service
from heliograph.serving.storage import Store, identity

WRITTEN = Path(__file__).parents[2] / "version_0_2"
OPTIONS = Options(2.0, 0.1)


@pytest.fixture(scope="module")
def program() -> NetworkProgram:
    return NetworkProgram(runpy.run_path(str(WRITTEN / "network.py"))["network"])


@pytest.fixture
def place(tmp_path) -> Path:
    with closing(sqlite3.connect(tmp_path / "store.db")) as connection:
        connection.executescript(gzip.decompress((WRITTEN / "store.sql.gz").read_bytes()).decode())
    return tmp_path / "store.db"


def content(place: Path) -> list[str]:
    with closing(sqlite3.connect(place)) as connection:
        return list(connection.iterdump())


def sent(begin: int, end: int) -> list[bytes]:
    """Messages of two plants from two nodes; every third of the second node lacks its value."""
    rows = []
    for k in range(begin, end):
        for p, plant in enumerate(("north", "south")):
            for i, node in enumerate("ab"):
                value = round(math.sin(k + p) + k * (1 - p / 2) + 0.1 * i, 3)
                row = {"plant": plant, "node": node, "sequence": k, "time": k, "arrival": k}
                row["values"] = [None if node == "b" and k % 3 == 1 else value]
                if node == "a":
                    row["inputs"] = [round(0.1 * p - 0.05, 3)]
                rows.append(json.dumps(row).encode())
    return rows


def finals(service: Service) -> list[dict]:
    known = [json.loads(output.body) for output in service.take(sent(6, 9))]
    return [output for output in known if output["kind"] == "final"]


def check_goes_on(known: list[dict]) -> None:
    """As version 0.2.0 went on, to 1e-9: the factors carry the same numbers to a few units of rounding."""
    lines = (WRITTEN / "finals.jsonl").read_text().splitlines()
    right = {(o["plant"], o["time"]): o["estimates"] for o in map(json.loads, lines)}
    assert {(o["plant"], o["time"]) for o in known} == set(right) and len(right) == 6
    for output in known:
        for node, filters in right[output["plant"], output["time"]].items():
            for name, (mean, covariance) in filters.items():
                estimate = output["estimates"][node][name]
                np.testing.assert_allclose(estimate["mean"], mean, rtol=1e-9)
                np.testing.assert_allclose(estimate["covariance"], covariance, rtol=1e-9)


def test_a_store_of_the_version_before_is_named_in_one_line_and_stays_as_it_is(place, program):
    before = content(place)
    with pytest.raises(hg.InputError) as refused:
        Store(str(place), identity(Fleet(program, OPTIONS)))
    assert str(refused.value) == (
        f"store {place}: expected layout 5, of heliograph {hg.__version__}, got layout 3, of heliograph 0.2.0; "
        "to begin anew, name another; --accept-changes goes on with what fits"
    )
    assert content(place) == before


@pytest.mark.parametrize("copied", [False, True])
def test_a_store_of_the_version_before_goes_on_where_the_user_says_so(place, program, tmp_path, copied):
    """In place, or in a new store with the old one as it is."""
    fleet, said, before = Fleet(program, OPTIONS), [], content(place)
    mine = identity(fleet)
    if copied:
        store = Store(str(tmp_path / "new.db"), mine)
        store.begin_from(str(place), mine, PlantMigration(fleet, mine, said.append))
        assert content(place) == before
    else:
        store = Store(str(place), mine, carrier=PlantMigration(fleet, mine, said.append))
    known = finals(Service(fleet, store))
    check_goes_on(known)
    assert [output["id"] for output in known] == list(range(1, 7) if copied else range(7, 13))  # of the journal
    versions = [line for line in said if "jax: " not in line]
    assert versions == [f"store {place}: heliograph: 0.2.0 -> {hg.__version__}"]
    store.close()
    Store(str(tmp_path / "new.db" if copied else place), mine).close()  # of this version now


@pytest.mark.slow
def test_filters_go_on_where_the_nodes_have_changed_places_too(place, program):
    """Then all columns are others, so that a flag with the place of another number would change that."""
    item = program.network
    network = hg.Network(item.plant, {name: item.nodes[name] for name in ("b", "a")}, item.fused)
    fleet = Fleet(NetworkProgram(network), OPTIONS)
    store = Store(str(place), identity(fleet), carrier=PlantMigration(fleet, identity(fleet), print))
    check_goes_on(finals(Service(fleet, store)))
    store.close()


def test_each_number_of_a_state_is_described_once(program):
    """Flags among them, whose columns cannot be told from the numbers in them."""
    layout = json.loads(identity(Fleet(program, OPTIONS))["description"])["layout"]
    columns = [i for parts in layout["filters"].values() for _, *ends in parts.values() for i in range(*ends)]
    assert sorted(columns) == list(range(layout["state"]))
