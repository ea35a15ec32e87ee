"""Where the state is kept: plants, what was told of them, and how far, in one transaction for each batch."""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    create_engine,
    delete,
    event,
    func,
    select,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Engine, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError

from heliograph.live.identity import Identity, check_same
from heliograph.numerics.check import InputError, fail
from heliograph.serving.keeping import ConflictError, Entry, Kept
from heliograph.serving.output import Output

TABLES = MetaData()
PLANTS = Table("plants", TABLES, Column("name", String(200), primary_key=True), Column("version", BigInteger),
               Column("body", LargeBinary))  # fmt: skip
JOURNAL = Table("journal", TABLES, Column("last", BigInteger, primary_key=True, autoincrement=False),
                Column("process", String(200)), Column("lines", Text))  # fmt: skip
NUMBERS = Table("numbers", TABLES, Column("name", String(220), primary_key=True), Column("value", BigInteger))
WHOSE = Table("whose", TABLES, Column("name", String(20), primary_key=True), Column("value", Text))
TOLD, NEWEST, MALFORMED = "told to the reader of {}", "journal", "malformed"
IDENTITY = "identity"
AT_ONCE = 500  # names in one question


class Store:
    """Plants and the journal in SQLite (a path) or PostgreSQL (a URL), for one process or several with names.

    The journal keeps the last `journal` entries and some more. Where a plant was committed by another process since it
    was read, nothing is committed.

    Raises:
        ValueError: a place that cannot be opened; the state of another network, version or precision.
    """

    keeps = True

    def __init__(self, place: str, mine: Identity, process: str = "", journal: int = 100_000):
        self.process, self.journal = process, journal
        self.url = _url(place)
        self._engine = _engine(self.url)
        self._insert: Any = postgresql.insert if self._engine.dialect.name == "postgresql" else sqlite.insert
        try:
            check_same(f"store {self.name}", mine, self._whose(mine))
        except DBAPIError as error:
            self.close()
            raise fail(f"store {self.name}", "a database that can be written", str(error.orig)) from None
        except InputError as error:
            self.close()
            raise InputError(f"{error}; to begin anew, name another") from None

    def _whose(self, mine: Identity) -> Identity:
        """What the store is of: of this network, if it is new."""
        TABLES.create_all(self._engine)
        with self._engine.begin() as connection:
            kept = connection.execute(select(WHOSE.c.value).where(WHOSE.c.name == IDENTITY)).scalar()
            if kept is None:
                connection.execute(self._insert(WHOSE), [{"name": IDENTITY, "value": json.dumps(mine)}])
        found: Identity = mine if kept is None else json.loads(kept)
        return found

    @property
    def name(self) -> str:
        """What to call it where others read: a file, or a URL without its password."""
        return (
            self.url.database or ""
            if self._engine.dialect.name == "sqlite"
            else self.url.render_as_string(hide_password=True)
        )

    def load(self, names: Iterable[str]) -> dict[str, Kept]:
        """The plants of these names that are kept."""
        with self._engine.connect() as connection:
            columns = PLANTS.c.name, PLANTS.c.version, PLANTS.c.body
            rows = _of(connection, columns, list(names))
        return {name: Kept(version, body) for name, version, body in rows}

    def commit(
        self, plants: Mapping[str, Kept], entries: Sequence[Entry], malformed: int, told: int | None
    ) -> list[Output]:
        """Keep plants, of the versions they had before, and what is to be told; `told`: up to where it was.

        Raises:
            ConflictError: a plant has another version.
        """
        try:
            return self._committed(plants, entries, malformed, told)
        except DBAPIError as error:
            raise fail(f"store {self.name}", "a database that takes a commit", str(error.orig)) from None

    def _committed(
        self, plants: Mapping[str, Kept], entries: Sequence[Entry], malformed: int, told: int | None
    ) -> list[Output]:
        with self._engine.begin() as connection:
            newest = self._count(connection, NEWEST, len(entries))
            found = dict(_of(connection, (PLANTS.c.name, PLANTS.c.version), list(plants)))
            if any(found.get(name, 0) != kept.version for name, kept in plants.items()):
                raise ConflictError
            outputs = [entry.numbered(newest - len(entries) + i) for i, entry in enumerate(entries, 1)]
            if plants:
                rows = [{"name": n, "version": kept.version + 1, "body": kept.body} for n, kept in plants.items()]
                self._put(connection, PLANTS, rows)
            if outputs:
                lines = b"\n".join([each.body for each in outputs]).decode()
                connection.execute(JOURNAL.insert(), [{"last": newest, "process": self.process, "lines": lines}])
                connection.execute(delete(JOURNAL).where(JOURNAL.c.last <= newest - self.journal))
            if malformed:
                self._count(connection, MALFORMED, malformed)
            if told is not None:
                self._put(connection, NUMBERS, [{"name": TOLD.format(self.process), "value": told}])
        return outputs

    def untold(self) -> list[Output]:
        """What this process committed and may not have told."""
        told = self.number(TOLD.format(self.process))
        return [each for each in self.entries(told, self.process) if each.number is not None and each.number > told]

    def entries(self, after: int = 0, process: str | None = None) -> list[Output]:
        """What the journal keeps from the batch on that has number `after` + 1; of one process, or of all."""
        wanted = JOURNAL.c.last > after
        if process is not None:
            wanted &= JOURNAL.c.process == process
        with self._engine.connect() as connection:
            found = connection.execute(select(JOURNAL.c.lines).where(wanted).order_by(JOURNAL.c.last)).scalars().all()
        return [_output(line) for lines in found for line in lines.split("\n")]

    def number(self, name: str) -> int:
        """A count that is kept."""
        with self._engine.connect() as connection:
            return int(connection.execute(select(NUMBERS.c.value).where(NUMBERS.c.name == name)).scalar() or 0)

    def begin_from(self, place: str, mine: Identity) -> None:
        """Take the plants of another store, which stays as it is.

        Raises:
            ValueError: plants here already; the state of another network, version or precision there.
        """
        other = Store(place, mine)
        with self._engine.begin() as here, other._engine.connect() as there:
            if here.execute(select(func.count()).select_from(PLANTS)).scalar():
                raise fail(f"store {self.name}", f"no plants yet, to begin from {other.name}", "some")
            for part in there.execute(select(PLANTS)).mappings().partitions(AT_ONCE):
                here.execute(PLANTS.insert(), [dict(row) for row in part])
        other.close()

    def count(self) -> int:
        """How many plants are kept."""
        with self._engine.connect() as connection:
            return int(connection.execute(select(func.count()).select_from(PLANTS)).scalar_one())

    def close(self) -> None:
        """Let go of the database."""
        self._engine.dispose()

    def _count(self, connection: Connection, name: str, more: int) -> int:
        """Add to a number, which locks it until the commit; what it is then."""
        new = self._insert(NUMBERS).values(name=name, value=more)
        done = new.on_conflict_do_update(index_elements=["name"], set_={"value": NUMBERS.c.value + more})
        return int(connection.execute(done.returning(NUMBERS.c.value)).scalar_one())

    def _put(self, connection: Connection, table: Table, rows: list[dict[str, object]]) -> None:
        """Insert rows, or replace those of the same name."""
        new = self._insert(table)
        others = {column.name: new.excluded[column.name] for column in table.c if not column.primary_key}
        connection.execute(new.on_conflict_do_update(index_elements=["name"], set_=others), rows)


def _of(connection: Connection, columns: Sequence[Column[object]], names: list[str]) -> list[Any]:
    """Columns of the plants of these names."""
    found: list[Any] = []
    for i in range(0, len(names), AT_ONCE):
        found += connection.execute(select(*columns).where(PLANTS.c.name.in_(names[i : i + AT_ONCE]))).all()
    return found


def engine_at(place: str) -> Engine:
    """The database of a store."""
    return _engine(_url(place))


def _output(line: str) -> Output:
    parts = json.loads(line)
    return Output(parts["id"], parts["plant"] or "", parts["kind"], line.encode())


def _url(place: str) -> URL:
    try:
        url = make_url(place) if "://" in place else URL.create("sqlite", database=place)
    except ArgumentError:
        raise fail("store", "a file, or a URL as postgresql://host/database", "something else") from None
    if url.get_backend_name() not in ("sqlite", "postgresql"):
        raise fail("store", "a file, or a URL as postgresql://host/database", url.get_backend_name())
    return url.set(drivername="postgresql+psycopg") if url.get_backend_name() == "postgresql" else url


def _engine(url: URL) -> Engine:
    engine = create_engine(url)
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _durably)
        event.listen(engine, "begin", _at_once)
    return engine


def _durably(connection: Any, _: object) -> None:
    """Each commit is on the disk before it returns; readers do not wait for it."""
    connection.isolation_level = None  # transactions begin where the engine says so
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "busy_timeout=30000"):
        connection.execute(f"PRAGMA {pragma}")


def _at_once(connection: Connection) -> None:
    """A transaction that will write waits for others before it reads."""
    connection.exec_driver_sql("BEGIN IMMEDIATE")
