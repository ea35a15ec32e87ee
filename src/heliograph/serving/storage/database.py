"""The database of a store: SQLite at a path or PostgreSQL at a URL, and how transactions begin there."""

import sqlite3
from typing import Any

from sqlalchemy import Connection, create_engine, event
from sqlalchemy.engine import URL, Engine, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, InterfaceError, OperationalError, SQLAlchemyError

from heliograph.numerics.check import fail, text

PAGES = "page_size=4096", "cache_size=-16384"  # bytes, of a new database: a small commit writes four; kB in memory
# Words in a server's refusal whose reason passes.
PASSING = "starting up", "shutting down", "terminating connection", "recovery mode", "too many clients"
PLACE = "a file, or a URL as postgresql://host/database"


def open_database(location: str) -> Engine:
    """Open the database of a store, at a path (SQLite) or a URL (PostgreSQL).

    Raises:
        ValueError: `location` is no path, or the URL of another kind of database. The message contains no password.
    """
    engine = create_engine(read_location(location))
    if engine.dialect.name == "sqlite":
        # Each commit is on the disk when it returns, and a transaction locks the database from its beginning.
        event.listen(engine, "connect", _configure_sqlite)
        event.listen(engine, "begin", _begin_immediate)
    return engine


def read_location(location: str) -> URL:
    """Return the URL of a store's database: SQLite for a path, or PostgreSQL.

    Raises:
        ValueError: no path, or the URL of another kind of database.
    """
    text("store", location)
    try:
        url = make_url(location) if "://" in location else URL.create("sqlite", database=location)
    except ArgumentError:
        raise fail("store", PLACE, "something else") from None
    if url.get_backend_name() not in ("sqlite", "postgresql"):
        raise fail("store", PLACE, url.get_backend_name())
    if url.get_backend_name() == "sqlite" and (url.database or "").strip() in ("", ":memory:"):
        raise fail("store", f"{PLACE}; none keeps nothing", repr(location))
    return url.set(drivername="postgresql+psycopg") if url.get_backend_name() == "postgresql" else url


def is_server_away(error: SQLAlchemyError) -> bool:
    """Return whether an error means that a server does not answer now, but may answer later.

    A server that refuses, such as for a wrong password, would refuse again, unless the reason will pass (PASSING), such
    as that it is starting. SQLite has no server.
    """
    if not isinstance(error, DBAPIError) or isinstance(error.orig, sqlite3.Error):
        return False
    said = str(error.orig)  # in the server's words, where FATAL means that it ended the connection
    refused = "FATAL" in said and not any(words in said for words in PASSING)
    lost = error.connection_invalidated or isinstance(error, OperationalError | InterfaceError)
    return lost and not refused


def _configure_sqlite(connection: Any, _: object) -> None:
    """Configure SQLite: each commit is on the disk before it returns, and readers do not wait for writers."""
    connection.isolation_level = None  # transactions begin when the engine says so
    connection.text_factory = lambda data: data.decode(errors="backslashreplace")  # for damaged names
    # WAL: readers do not wait. FULL: commits are on the disk. busy_timeout: milliseconds to wait for another writer.
    for pragma in (*PAGES, "journal_mode=WAL", "synchronous=FULL", "busy_timeout=30000"):
        connection.execute(f"PRAGMA {pragma}")


def _begin_immediate(connection: Connection) -> None:
    """Begin a transaction with the write lock, so that it never has to upgrade a read lock."""
    connection.exec_driver_sql("BEGIN IMMEDIATE")
