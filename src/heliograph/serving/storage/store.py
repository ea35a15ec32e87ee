"""Store of a service's state, in one transaction for each batch: plants, outputs, progress; rows with checksums."""

import json
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from shlex import quote
from typing import Any

from sqlalchemy import Connection, Table, delete, func, inspect, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import SQLAlchemyError

from heliograph.live.stored.migration import PlantMigration
from heliograph.live.stored.network_changes import DESCRIPTION, LISTED, list_changes
from heliograph.live.stored.snapshot import Identity, check_same_network, list_versions
from heliograph.numerics.check import InputError, fail, table
from heliograph.serving.output import Output, parse_output
from heliograph.serving.storage.database import is_server_away, open_database
from heliograph.serving.storage.store_protocol import AwayError, ConflictError, DamagedRow, Entry, StoredPlant
from heliograph.serving.storage.store_tables import (
    AT_ONCE,
    CARRIED,
    IDENTITY_TABLE,
    JOURNAL,
    LAYOUT,
    LAYOUT_KEY,
    NUMBERS,
    PLANTS,
    TABLES,
    add_checksum,
    checksum,
    is_name_undamaged,
    is_row_undamaged,
    select_plants,
)

# Names of stored counts: the newest output published (by process), the newest output, and unreadable messages.
PUBLISHED, NEWEST, MALFORMED = "published to the reader of {}", "journal", "malformed"
WORD, TOPIC = "last word on ", 200  # before a topic: the last status of its device; characters of the longest one
IDENTITY = "identity"
MEND = "its plants go on in a new store with --store NEW --from-snapshot"


class Store:
    """Plants and a journal of outputs in SQLite (a path) or PostgreSQL (a URL), for one process or several with names.

    If a plant was committed by another process since it was read, nothing is committed. Every row has a checksum;
    `damaged` are plants with rows that are not as written; a new name may be one of them, if its name is damaged.

    Args:
        location: a path, or a URL of PostgreSQL.
        mine: identity of the network, which a stored state must agree with (`identity`); None opens any.
        process: name of this process in the journal; empty if there is only one.
        journal: number of outputs that the journal keeps at least (default 100,000).
        opened: a store open on the same location, which has already looked for damage.
        carrier: carries the plants of another network over; None refuses these.
        begun: whether it must hold a state already, since another store begins from it.

    Raises:
        ValueError: a location that cannot be opened; a database that is damaged as a whole; the state of another
            network, version or precision.
    """

    keeps = True

    def __init__(
        self,
        location: str,
        mine: Identity | None,
        process: str = "",
        journal: int = 100_000,
        opened: "Store | None" = None,
        carrier: PlantMigration | None = None,
        begun: bool = False,
    ):
        """Open the database, or make it, and check that it is of the network `mine`. The arguments are the class's."""
        self.process, self.journal, self._begun = process, journal, begun
        self.identity: Identity = {}
        mine = None if mine is None else table("identity of a store", mine, "texts") | {LAYOUT_KEY: LAYOUT}
        self._engine = open_database(location)
        weakref.finalize(self, self._engine.dispose)  # for a store that is dropped without being closed
        self._insert: Any = postgresql.insert if self._engine.dialect.name == "postgresql" else sqlite.insert
        # A store that cannot be used is closed.
        try:
            with self._name_store_in_errors("a database that can be written"):
                self._open_state(mine, opened, carrier)
        except AwayError:
            self.close()
            raise
        except InputError as error:
            self.close()
            can_be_carried = carrier is None and self.identity.get(LAYOUT_KEY) in CARRIED
            more = "; --accept-changes goes on with what fits" if can_be_carried else ""
            raise InputError(f"{error}; to begin anew, name another{more}") from None

    def _open_state(self, mine: Identity | None, opened: "Store | None", carrier: PlantMigration | None) -> None:
        """Read the identity, raise ValueError if the state cannot be used, find damaged plants, and carry plants over.

        The arguments are the class's; `mine` also has the layout of this version.
        """
        self.identity = self._read_identity(mine)
        self._check_layout(carrier is not None or mine is None)
        # The network must be the same, unless its plants are carried over or any will do.
        if carrier is None and mine is not None:
            self._check_network(mine)
        self.damaged: dict[str, DamagedRow] = self._find_damaged() if opened is None else opened.damaged
        if carrier is not None and self.identity != carrier.mine | {LAYOUT_KEY: LAYOUT}:
            self.carry(carrier, f"store {self.name}", self.identity)

    def _check_network(self, mine: Identity) -> None:
        """Raise ValueError, which names what differs, if the store's state is of another network than `mine`."""
        # Leave out the descriptions: the other parts hold hashes of their numbers.
        here, there = ({key: part for key, part in one.items() if key != DESCRIPTION} for one in (mine, self.identity))
        if here == there:
            return
        try:
            differs = list_changes(mine, self.identity)
        except (KeyError, ValueError, TypeError, AttributeError):  # the numbers are missing or damaged
            differs = []
        if differs:
            more = f" and {len(differs) - LISTED} more" if len(differs) > LISTED else ""
            got = f"one that differs: {'; '.join(differs[:LISTED])}{more}"
            raise fail(f"store {self.name}", "the state of what is here", got)
        check_same_network(f"store {self.name}", here, there)

    @contextmanager
    def _name_store_in_errors(self, expected: str) -> Iterator[None]:
        """Within the `with` block, turn errors of the database into one line that names the store.

        It says what was `expected`. AwayError means that a server does not answer now, so that one may try again.
        """
        try:
            yield
        except UnicodeError:  # the database's message quotes a damaged name
            raise self._make_unreadable_error("bytes that are no text") from None
        except SQLAlchemyError as error:
            said = getattr(error, "orig", None) or type(error).__name__
            if is_server_away(error):
                raise AwayError(str(fail(f"store {self.name}", "a server that answers", str(said)))) from None
            raise fail(f"store {self.name}", expected, str(said)) from None

    def _read_identity(self, mine: Identity | None) -> Identity:
        """Return the identity of the network that the store is of; a new store takes `mine`, that of the present one.

        Raises:
            ValueError: a store that is damaged, or new although it is only read (`_begun`) or there is no `mine`.
        """
        # All tables are there, or none: a store with some missing is damaged.
        tables = set(inspect(self._engine).get_table_names()) & set(TABLES.tables)
        if tables and tables != set(TABLES.tables):
            raise self._make_unreadable_error(f"no table {', '.join(sorted(set(TABLES.tables) - tables))}")
        empty = fail(f"store {self.name}", "plants to begin from", "an empty one")
        if self._begun and not tables:  # nothing is written into what is only read
            raise empty
        TABLES.create_all(self._engine)
        with self._engine.begin() as connection:
            stored = connection.scalar(select(IDENTITY_TABLE.c.value).where(IDENTITY_TABLE.c.name == IDENTITY))
            if stored is None:
                # A store without an identity is new, unless it has counted something.
                if connection.execute(select(func.count()).select_from(NUMBERS)).scalar():
                    raise self._make_unreadable_error("no network that it is of")
                if mine is None or self._begun:
                    raise empty
                connection.execute(self._insert(IDENTITY_TABLE), [{"name": IDENTITY, "value": json.dumps(mine)}])
                return mine
        try:
            return dict({LAYOUT_KEY: "1"} | json.loads(stored))  # the first layout did not name itself
        except (ValueError, TypeError):  # no JSON, or no table
            raise self._make_unreadable_error("no network that it is of") from None

    def _check_layout(self, carried: bool) -> None:
        """Raise ValueError if the store has another layout, unless its plants are `carried` over and can be."""
        layout, release = self.identity.get(LAYOUT_KEY), self.identity.get("heliograph", "an unknown release")
        if layout == LAYOUT or (carried and layout in CARRIED):
            return
        why = "" if layout in CARRIED else ", whose plants cannot be carried over"
        raise fail(f"store {self.name}", f"layout {LAYOUT}, of heliograph {list_versions()['heliograph']}",
                   f"layout {layout}, of heliograph {release}{why}")  # fmt: skip

    def _find_damaged(self) -> dict[str, DamagedRow]:
        """Return by name the plants' rows that do not match their checksums; raise if the whole file is damaged."""
        results: dict[str, DamagedRow] = {}
        with self._engine.connect() as connection:
            if self._engine.dialect.name == "sqlite":
                said = connection.exec_driver_sql("PRAGMA integrity_check(1)").scalar()
                if said != "ok":
                    raise self._make_unreadable_error(f"{said}")
            for rows in connection.execution_options(yield_per=AT_ONCE).execute(select(PLANTS)).partitions():
                for name, version, body, written in rows:
                    if not is_row_undamaged(written, name, version, body):
                        results[str(name)] = DamagedRow(is_name_undamaged(written, name), written)
        return results

    def _make_unreadable_error(self, what: str) -> InputError:
        """Return the error of a store that cannot be read."""
        return fail(f"store {self.name}", "a database as it was written", f"one that is damaged: {what}")

    @property
    def name(self) -> str:
        """Return the store's name for messages: a file, or a URL without its password."""
        url = self._engine.url
        return url.database or "" if url.get_backend_name() == "sqlite" else url.render_as_string(hide_password=True)

    def load(self, names: Iterable[str]) -> dict[str, StoredPlant]:
        """Return {name: its stored plant}, of these names; of one that is damaged only what is wrong with it."""
        names = list(names)
        with self._name_store_in_errors("a database that can be read"), self._engine.connect() as connection:
            rows = select_plants(connection, list(PLANTS.c), names)
        results = {}
        for name, version, body, written in rows:
            if is_row_undamaged(written, name, version, body):
                results[name] = StoredPlant(version, body)
            else:
                results[name] = StoredPlant(0, b"", damage=self._describe_damage(name, "a damaged one"))
        # A name that is not stored may be that of a plant whose name is damaged.
        nameless = [name for name, damage in self.damaged.items() if not damage.named]
        for name in names if nameless else ():
            got = f"none of that name, and damaged ones that may have had it: {', '.join(map(repr, nameless))}"
            results.setdefault(name, StoredPlant(0, b"", damage=self._describe_damage(name, got)))
        return results

    def _describe_damage(self, name: str, got: str) -> str:
        """Return in words that the state of a plant is damaged, with what was found (`got`) and how to mend it."""
        anew = f"--anew {quote(name)} begins it anew"
        return f"{fail(f'store {self.name}, plant {name!r}', 'the state that was written', got)}; {anew}"

    def begin_anew(self, names: Iterable[str]) -> None:
        """Remove the plants of these names, damaged or not; each begins anew with its next message."""
        with self._name_store_in_errors("a database that takes a commit"), self._engine.begin() as connection:
            for name in names:
                damage = self.damaged.pop(name, None)
                # A damaged name may equal no given name. Its row is found by its checksum instead.
                has_lost_name = damage is not None and not damage.named
                is_plant = PLANTS.c.checksum == damage.checksum if damage and has_lost_name else PLANTS.c.name == name
                if not connection.execute(delete(PLANTS).where(is_plant)).rowcount:
                    raise fail(f"store {self.name}, --anew", "the name of a plant that it has", repr(name))

    def commit(
        self, plants: Mapping[str, StoredPlant], entries: Sequence[Entry], malformed: int, published: int | None
    ) -> list[Output]:
        """Commit plants and outputs in one transaction; return the outputs with numbers (see `StoreProtocol`).

        Raises:
            ConflictError: another process has committed one of the plants.
        """
        with self._name_store_in_errors("a database that takes a commit"):
            return self._commit_at_once(plants, entries, malformed, published)

    def _commit_at_once(
        self, plants: Mapping[str, StoredPlant], entries: Sequence[Entry], malformed: int, published: int | None
    ) -> list[Output]:
        """Commit in one transaction: check the versions, then write plants, journal and counts; return the outputs.

        Args:
            plants: the changed plants as bytes, by name, with the versions that they were read with.
            entries: outputs (estimates, reports) for the journal, which get numbers in order.
            malformed: how many more messages could not be read.
            published: number of the newest output that was published; None if none was since the last commit.
        """
        with self._engine.begin() as connection:
            # The count locks the store for the other processes, which then see the new versions.
            newest = self._add_to_count(connection, NEWEST, len(entries))
            # If another process has committed one of the plants since it was read, nothing is committed.
            versions = dict(select_plants(connection, (PLANTS.c.name, PLANTS.c.version), list(plants)))
            if any(versions.get(name, 0) != plant.version for name, plant in plants.items()):
                raise ConflictError
            outputs = Entry.numbered(entries, newest - len(entries) + 1)
            # Plants with their next version, the batch in the journal, and the counts.
            if plants:
                next_versions = ((name, plant.version + 1, plant.body) for name, plant in plants.items())
                self._upsert(connection, PLANTS, [add_checksum(PLANTS, *row) for row in next_versions])
            if outputs:
                lines = b"\n".join([output.body for output in outputs]).decode()
                connection.execute(JOURNAL.insert(), [add_checksum(JOURNAL, newest, self.process, lines)])
                connection.execute(delete(JOURNAL).where(JOURNAL.c.last <= newest - self.journal))
            if malformed:
                self._add_to_count(connection, MALFORMED, malformed)
            if published is not None:
                self._upsert(connection, NUMBERS, [add_checksum(NUMBERS, PUBLISHED.format(self.process), published)])
        return outputs

    def unpublished(self) -> list[Output]:
        """Return the outputs that this process committed after the last one that it recorded as published.

        Some of them may be published all the same, since this is recorded with the next commit only.
        """
        published = self.number(PUBLISHED.format(self.process))
        entries = self.entries(published, self.process)
        return [entry for entry in entries if entry.number is not None and entry.number > published]

    def entries(self, after: int = 0, process: str | None = None) -> list[Output]:
        """Return the journal's outputs from the first batch that ends after number `after` on, of one process or all.

        Raises:
            ValueError: an entry is damaged.
        """
        select_batches = select(JOURNAL).where(JOURNAL.c.last > after).order_by(JOURNAL.c.last)
        outputs = list[Output]()
        with self._name_store_in_errors("a database that can be read"), self._engine.connect() as connection:
            for last, by, lines, written in connection.execute(select_batches):
                if not is_row_undamaged(written, last, by, lines):
                    got = f"damage in those up to number {last}; {MEND} {self.name}"
                    raise fail(f"store {self.name}, journal", "entries as they were written", got)
                if process in (None, by):
                    outputs += [parse_output(line) for line in lines.split("\n")]
        return outputs

    def number(self, name: str) -> int:
        """Return the stored count of this name, such as that of published outputs; 0 if none was stored."""
        with self._name_store_in_errors("a database that can be read"), self._engine.connect() as connection:
            row = connection.execute(select(NUMBERS).where(NUMBERS.c.name == name)).first()
        return 0 if row is None else self._check_count(*row)

    def words(self) -> dict[str, int]:
        """Return the last stored status of each device (online or not), as a number by topic."""
        select_words = select(NUMBERS).where(NUMBERS.c.name.startswith(WORD, autoescape=True))
        with self._name_store_in_errors("a database that can be read"), self._engine.connect() as connection:
            rows = connection.execute(select_words).all()
        return {name.removeprefix(WORD): self._check_count(name, value, written) for name, value, written in rows}

    def keep_words(self, words: Mapping[str, int]) -> None:
        """Store the last status of devices, as a number by topic; a topic longer than TOPIC is left out."""
        if rows := [add_checksum(NUMBERS, WORD + topic, word) for topic, word in words.items() if len(topic) <= TOPIC]:
            with self._name_store_in_errors("a database that can be written"), self._engine.begin() as connection:
                self._upsert(connection, NUMBERS, rows)

    def _check_count(self, name: str, value: int, written: int) -> int:
        """Return a stored count `value`; raise ValueError if `written` is not its checksum."""
        if not is_row_undamaged(written, name, value):
            raise fail(f"store {self.name}, count {name!r}", "what was written", f"damage; {MEND} {self.name}")
        return value

    def carry(self, carrier: PlantMigration, what: str, stored: Identity) -> None:
        """Rewrite all plants of this store for another network, and then the store's identity.

        Args:
            carrier: translates stored plants into those of the other network.
            what: name of the store that they come from, for reports.
            stored: identity of the network that they are of.
        """
        carrier.begin(what, stored)
        mine = carrier.mine | {LAYOUT_KEY: LAYOUT}
        with self._engine.begin() as connection:
            names = [name for (name,) in connection.execute(select(PLANTS.c.name)) if name not in self.damaged]
            for i in range(0, len(names), AT_ONCE):
                rows = select_plants(connection, list(PLANTS.c), names[i : i + AT_ONCE])
                versions = {name: version for name, version, _, _ in rows}
                bodies = carrier.migrate({name: body for name, _, body, _ in rows})
                after = [add_checksum(PLANTS, name, versions[name] + 1, body) for name, body in bodies.items()]
                self._upsert(connection, PLANTS, after)
            update_identity = update(IDENTITY_TABLE).where(IDENTITY_TABLE.c.name == IDENTITY)
            connection.execute(update_identity.values(value=json.dumps(mine)))
        self.identity = mine

    def begin_from(self, location: str, mine: Identity, carrier: PlantMigration | None = None) -> None:
        """Copy the plants of another store into this empty one; `carrier` converts them to this network."""
        other = Store(location, mine if carrier is None else None, begun=True)
        name_store = self._name_store_in_errors(f"a database that takes the plants of {other.name}")
        with name_store, self._engine.begin() as here, other._engine.connect() as there:
            if here.execute(select(func.count()).select_from(PLANTS)).scalar():
                raise fail(f"store {self.name}", f"no plants yet, to begin from {other.name}", "some")
            for rows in there.execute(select(PLANTS)).mappings().partitions(AT_ONCE):
                here.execute(PLANTS.insert(), [dict(row) for row in rows])
        self.damaged = other.damaged
        other.close()
        if carrier is not None and other.identity != self.identity:
            self.carry(carrier, f"store {other.name}", other.identity)

    def count(self) -> int:
        """Return the number of stored plants."""
        with self._name_store_in_errors("a database that can be read"), self._engine.connect() as connection:
            return int(connection.execute(select(func.count()).select_from(PLANTS)).scalar_one())

    def names(self) -> list[str]:
        """Return the names of all stored plants."""
        with self._name_store_in_errors("a database that can be read"), self._engine.connect() as connection:
            return [str(name) for name in connection.execute(select(PLANTS.c.name)).scalars()]

    def close(self) -> None:
        """Close the database."""
        self._engine.dispose()

    def _add_to_count(self, connection: Connection, name: str, more: int) -> int:
        """Add `more` to a stored count, renew its checksum, and return it; the count is locked until the commit."""
        insert = self._insert(NUMBERS).values(add_checksum(NUMBERS, name, more))
        upsert = insert.on_conflict_do_update(index_elements=["name"], set_={"value": NUMBERS.c.value + more})
        value, written = connection.execute(upsert.returning(NUMBERS.c.value, NUMBERS.c.checksum)).one()
        # If the count existed, its checksum is still that of the old value: check that, and renew it.
        if written != checksum(name, value):
            value = self._check_count(name, value - more, written) + more
            is_count = NUMBERS.c.name == name
            connection.execute(update(NUMBERS).where(is_count).values(checksum=checksum(name, value)))
        return int(value)

    def _upsert(self, connection: Connection, table: Table, rows: list[dict[str, object]]) -> None:
        """Insert rows in a table whose key is the name, or replace those of the same name."""
        insert = self._insert(table)
        new_values = {column.name: insert.excluded[column.name] for column in table.c if not column.primary_key}
        connection.execute(insert.on_conflict_do_update(index_elements=["name"], set_=new_values), rows)
