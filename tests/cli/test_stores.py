"""`heliograph run` from one store to another, and what it says of stores that cannot be used."""

import pytest

from heliograph import cli
from heliograph.files.tables.table import read_table
from tests.cli.example import refused, run_arguments
from tests.files.stores.answering import Answering
from tests.postgres import Postgres

FIRST = 1_790_000_000  # seconds since 1970
ROWS = {
    "name": "yard",
    "columns": ["time", "push", "pos"],
    "values": [[(FIRST + k) * 10**9, push, pos] for k, push, pos in [(0, 0, 0.5), (1, 1, None), (2, 0, 0.7)]],
}
MAPPED = """
sources = {"yard": h.files.json_field("pos", node="remote", time="time")}
"""


def dated(folder):
    """The same rows in a file."""
    cells = [(push, "" if pos is None else pos) for _, push, pos in ROWS["values"]]
    lines = [f"2026-09-21T14:13:{20 + k}Z,{push},{pos}" for k, (push, pos) in enumerate(cells)]
    (folder / "data.csv").write_text("\n".join(["time,push,pos", *lines, ""]))


def test_run_reads_and_writes_influx_as_it_does_files(folder, capsys):
    dated(folder)
    assert cli.main(run_arguments()) == 0
    table = read_table("out.csv")
    capsys.readouterr()
    with Answering([ROWS]) as server:
        assert cli.main(run_arguments(measurements=f"{server.url}?table=yard", out=f"{server.url}?table=found")) == 0
    said = capsys.readouterr()
    assert said.out == f"{server.url}?table=found: 3 rows of remote/aware (nominal), remote/trusting (nominal)\n"
    lines = server.asked[-1][3].decode().splitlines()
    for k, line in enumerate(lines):
        head, fields, time = line.split(" ")
        assert (head, int(time)) == ("found", table["time"][k].astype(int))
        values = dict(field.split("=") for field in fields.split(","))
        assert float(values["aware.p"]) == table["aware.p"][k]
        assert float(values["trusting.v.sd"]) == table["trusting.v.sd"][k]


def test_a_measurement_of_the_sources_is_messages(folder, capsys):
    text = (folder / "net.py").read_text()
    network = text.replace('"push", "dt"', '"dt"').replace("u[1] * jnp.array([x[1], u[0]])", "u[0] * x[::-1]")
    (folder / "net.py").write_text(network + MAPPED)
    answer = ROWS | {"columns": ["time", "gate", "pos"], "values": [[t, "a", 0.5] for t, *_ in ROWS["values"]]}
    with Answering([answer]) as server:
        assert cli.main(run_arguments(measurements=f"{server.url}?table=yard")) == 0
    assert "remote: 3 used" in capsys.readouterr().out


def test_stores_that_cannot_be_used_are_one_line(folder, capsys):
    with Answering([{"name": "yard", "columns": ["pos"], "values": [[1.0]]}]) as server:
        url = server.url
        refused(folder, capsys, run_arguments(measurements=f"{url}?table=yard"), "expected a query that returns time")
        refused(
            folder, capsys, run_arguments(out=f"{url}?query=SELECT"), "the table to write, ?table=NAME, got a query"
        )
    refused(folder, capsys, run_arguments(out=url), f"{url}: expected a server that answers, got Connection refused")
    refused(folder, capsys, run_arguments(measurements=url), "expected ?query=SELECT... or ?table=NAME behind it")
    refused(folder, capsys, run_arguments(measurements="influx://host"), "store: expected influx://HOST:PORT/DATABASE")


@pytest.mark.real("PostgreSQL")
def test_run_reads_and_writes_postgresql(folder, capsys):
    import psycopg

    dated(folder)
    assert cli.main(run_arguments()) == 0
    table = read_table("out.csv")
    with Postgres() as server:
        url = server.database()
        with psycopg.connect(url) as connection:
            connection.execute("CREATE TABLE yard (time timestamptz, push float8, pos float8)")
            with connection.cursor().copy("COPY yard FROM STDIN (FORMAT csv, HEADER)") as copy:
                copy.write((folder / "data.csv").read_text())
        asked = f"{url}&query=SELECT time, push, pos FROM yard ORDER BY time"
        assert cli.main(run_arguments(measurements=asked, out=f"{url}&table=found")) == 0
        with psycopg.connect(url) as connection:
            rows = connection.execute('SELECT "aware.p", "trusting.v.sd" FROM found ORDER BY time').fetchall()
        assert rows == list(zip(table["aware.p"].tolist(), table["trusting.v.sd"].tolist(), strict=True))
        assert cli.main([*run_arguments(measurements=asked, out=f"{url}&table=ahead"), "--forecast", "2"]) == 0
        with psycopg.connect(url) as connection:
            assert connection.execute("SELECT count(*) FROM ahead WHERE forecast").fetchall() == [(2,)]
