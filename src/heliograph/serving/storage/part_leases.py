"""Leases of the parts of the plants to processes, in the database that keeps the plants."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Column, Connection, Float, Integer, MetaData, String, Table, delete, select, text
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import Engine
from sqlalchemy.exc import SQLAlchemyError

from heliograph.numerics.check import fail
from heliograph.serving.storage.database import is_server_away
from heliograph.serving.storage.store_protocol import AwayError

TABLES = MetaData()
PROCESSES = Table("processes", TABLES, Column("name", String(200), primary_key=True), Column("until", Float))
PARTS = Table(
    "parts",
    TABLES,
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("process", String(200)),
    Column("until", Float),
)
NOW = {  # one clock for all: the database's
    "sqlite": text("SELECT (julianday('now') - 2440587.5) * 86400.0"),
    "postgresql": text("SELECT extract(epoch FROM clock_timestamp())::float8"),
}
TERM = 5.0  # seconds that a lease lasts: so long after a process died its parts are idle


class Leases:
    """Leases a process's share of `parts` parts: all live processes have equally many, up to one.

    A lease makes it likely that one process reads a part at a time, which keeps messages in order. That no message is
    used twice does not depend on leases or clocks: the commit of a plant fails if another was made since it was read.
    """

    def __init__(self, engine: Engine, process: str, parts: int, term: float = TERM):
        """Make the tables of leases if the database has none.

        Args:
            engine: the engine of the database.
            process: name of this process.
            parts: number of parts of the plants.
            term: seconds of a lease.
        """
        self.engine, self.process, self.parts, self.term = engine, process, parts, term
        self._insert = postgresql.insert if engine.dialect.name == "postgresql" else sqlite.insert
        TABLES.create_all(engine)

    def renew(self) -> set[int]:
        """Report that this process is alive, lease its parts anew, and return the numbers of those that it has now.

        A part is a share of the plants. These are the parts that it had, then free ones, up to its fair share.

        Raises:
            AwayError: the database does not answer now.
        """
        with self._raise_if_away(), self.engine.begin() as connection:
            now = float(connection.execute(NOW[self.engine.dialect.name]).scalar_one())
            fair_share = self._report_and_count_fair_share(connection, now)
            # Leases that are not over, of all processes.
            select_leased = select(PARTS.c.number, PARTS.c.process).where(PARTS.c.until >= now)
            process_of_part = {row.number: row.process for row in connection.execute(select_leased)}
            own = [number for number in sorted(process_of_part) if process_of_part[number] == self.process]
            free = [number for number in range(self.parts) if number not in process_of_part]
            return {number for number in (own + free)[:fair_share] if self._lease(connection, number, now)}

    @contextmanager
    def _raise_if_away(self) -> Iterator[None]:
        """Within the `with` block, raise a one-line AwayError if the database does not answer; pass on other errors."""
        try:
            yield
        except SQLAlchemyError as error:
            if not is_server_away(error):
                raise
            said = str(getattr(error, "orig", error))
            raise AwayError(str(fail("leases of parts", "a database that answers", said))) from None

    def release(self, number: int) -> None:
        """Release one part to other processes."""
        with self._raise_if_away(), self.engine.begin() as connection:
            connection.execute(delete(PARTS).where((PARTS.c.number == number) & (PARTS.c.process == self.process)))

    def leave(self) -> None:
        """Release all parts of this process, and its name, so that it no longer counts in the others' shares."""
        with self._raise_if_away(), self.engine.begin() as connection:
            connection.execute(delete(PARTS).where(PARTS.c.process == self.process))
            connection.execute(delete(PROCESSES).where(PROCESSES.c.name == self.process))

    def _report_and_count_fair_share(self, connection: Connection, now: float) -> int:
        """Report that this process is alive, forget dead processes, and return how many parts this one should have.

        A dead process has not reported for longer than the term. If the parts do not divide evenly, the first processes
        by name get one more.
        """
        connection.execute(delete(PROCESSES).where(PROCESSES.c.until < now))
        insert = self._insert(PROCESSES).values(name=self.process, until=now + self.term)
        connection.execute(insert.on_conflict_do_update(index_elements=["name"], set_={"until": now + self.term}))
        alive = sorted(row.name for row in connection.execute(select(PROCESSES.c.name)))
        each, remainder = divmod(self.parts, len(alive))
        return each + (alive.index(self.process) < remainder)

    def _lease(self, connection: Connection, number: int, now: float) -> bool:
        """Lease the part of this number until `now` + term if it is ours or free; return whether it is ours now."""
        lease = {"process": self.process, "until": now + self.term}
        insert = self._insert(PARTS).values(number=number, **lease)
        # An existing row is changed only if its lease is over or ours. Otherwise nothing is returned.
        is_free_or_own = (PARTS.c.until < now) | (PARTS.c.process == self.process)
        upsert = insert.on_conflict_do_update(index_elements=["number"], set_=lease, where=is_free_or_own)
        return connection.execute(upsert.returning(PARTS.c.number)).first() is not None
