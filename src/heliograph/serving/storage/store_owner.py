"""The owner of a store: the service that has it now, so that a second one says whose it is."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from zlib import crc32

from sqlalchemy import text
from sqlalchemy.engine import Engine
from sqlalchemy.exc import SQLAlchemyError

from heliograph.numerics.check import InputError, fail
from heliograph.serving.storage.database import is_server_away, open_database
from heliograph.serving.storage.store_protocol import AwayError

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

# Asks PostgreSQL which session has an advisory lock, and from which machine.
WHOSE = text("""
    SELECT application_name, coalesce(client_addr::text, 'its own machine') FROM pg_stat_activity
    WHERE pid = (SELECT pid FROM pg_locks WHERE locktype = 'advisory' AND objid::bigint = :key AND classid = :space
                 AND granted AND database = (SELECT oid FROM pg_database WHERE datname = current_database()) LIMIT 1)
""")
SPACE = 0x68656C69  # of the locks of this package
MEND = "stop it, name another --store, or give each a --process"


def name_of_process() -> str:
    """Return the name of this process for others: machine and number."""
    return f"{socket.gethostname()} {os.getpid()}"


@contextmanager
def own_store(location: str, process: str) -> Iterator[None]:
    """Own a store for a block, for services of one name; the operating system, or the server, ends it with the process.

    A store (the database of all plants' states) has one service of each name; a second one is refused, and told whose
    it is. A file is locked by the operating system through a file beside it, which contains the owner's name; a
    database of PostgreSQL by an advisory lock of a connection, for which nothing is written.

    Args:
        location: a path, or a URL of PostgreSQL.
        process: name of this service among several that share the store; empty if there is only one.

    Raises:
        ValueError: another service has it; the message says which.
    """
    engine = open_database(location)
    try:
        if engine.dialect.name == "postgresql":
            with _lock_session(engine, process):
                yield
        else:
            with _lock_file(str(engine.url.database), process):
                yield
    except SQLAlchemyError as error:
        # A server that is away may come back, so that the caller can try again; any other error is final.
        where = engine.url.render_as_string(hide_password=True)
        refused = fail(f"store {where}", "a server that answers", str(getattr(error, "orig", error)))
        raise AwayError(str(refused)) if is_server_away(error) else refused from None
    finally:
        engine.dispose()


@contextmanager
def _lock_file(path: str, process: str) -> Iterator[None]:
    """Hold a lock on a file beside an SQLite store within the `with` block; raise if another process has it.

    The file has the name of the process that holds the lock, for the error that others get.
    """
    safe_name = "".join(c if c.isalnum() else "-" for c in process)  # a process's name may be no name of a file
    lock = f"{path}{'.' if process else ''}{safe_name}.lock"
    try:
        file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError:  # the store itself says that nothing can be written there
        yield
        return
    try:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise _make_taken_error(path, os.read(file, 200).decode(errors="replace").strip()) from None
        os.ftruncate(file, 0)
        os.write(file, f"{name_of_process()}\n".encode())
        yield
    finally:
        os.close(file)


@contextmanager
def _lock_session(engine: Engine, process: str) -> Iterator[None]:
    """Hold PostgreSQL's advisory lock for the name `process` within the `with` block; raise if it is taken.

    The session is named after this machine's process, so that others are told who has the lock.
    """
    key = crc32(process.encode()) >> 1  # 31 bits, since the server takes signed numbers of 32 bits
    with engine.connect() as connection:
        session_name = f"heliograph {name_of_process()}"[:63]
        connection.execute(text("SELECT set_config('application_name', :name, false)"), {"name": session_name})
        lock = {"space": SPACE, "key": key}
        if not connection.execute(text("SELECT pg_try_advisory_lock(:space, :key)"), lock).scalar():
            row = connection.execute(WHOSE, lock).first()
            whose = "" if row is None else f"{row[0].removeprefix('heliograph ')} at {row[1]}"
            raise _make_taken_error(engine.url.render_as_string(hide_password=True), whose)
        connection.commit()
        yield


def _make_taken_error(where: str, whose: str) -> InputError:
    """Return the error that another service has the store."""
    return fail(f"store {where}", "one that no other service has", f"that of {whose or 'another'}; {MEND}")
