"""Addresses of stores: a URL with a query or a table; secrets are never printed."""

import os
import re
from dataclasses import dataclass, field, replace
from typing import Literal, cast
from urllib.parse import SplitResult, unquote, urlsplit, urlunsplit

SHAPE = "influx://HOST:PORT/DATABASE or postgresql://HOST/DATABASE, with ?table=NAME or ?query=SELECT..."
INFLUX, POSTGRES = ("influx", "influxs"), ("postgresql",)
USER, PASSWORD = "HELIOGRAPH_STORE_USER", "HELIOGRAPH_STORE_PASSWORD"
ESTIMATES = "estimates"  # the table that is written, unless the URL names another
Language = Literal["query", "flux", "sql"]  # InfluxQL, or the SQL of PostgreSQL; Flux; the SQL of InfluxDB 3
ASKS = re.compile(r"(?<=[?&])(query|flux|sql)=")  # begins a statement, which goes to the end of the URL


@dataclass(frozen=True)
class StoreAddress:
    """Where a table is kept, or the statement that asks for one; `str` of it is the URL without secrets and query.

    Attributes:
        kind: scheme of the URL: "influx", "influxs" (TLS) or "postgresql".
        url: the URL without table and query, with its secrets.
        database: name of the database; of InfluxDB 2 that of a bucket.
        table: table (of InfluxDB a measurement) that is read or written; "" if the URL names none.
        query: statement that is asked instead; "" if the URL has none.
        language: of the statement, as the URL names it.
        organisation: of InfluxDB 2, in which Flux is asked; "" if the URL names none.
    """

    kind: str
    url: str = field(repr=False)
    database: str
    table: str
    query: str = field(repr=False)
    language: Language = "query"
    organisation: str = ""

    def __str__(self) -> str:
        """Return the address for notes and errors, without user and password."""
        parts = urlsplit(self.url)
        host = f"{parts.hostname or ''}{'' if parts.port is None else f':{parts.port}'}"
        return f"{self.kind}://{host}/{self.database}{f'?table={self.table}' if self.table else ''}"

    @property
    def table_for_estimates(self) -> str:
        """Return the table that estimates are written to."""
        return self.table or ESTIMATES

    def with_table(self, table: str) -> "StoreAddress":
        """Return the address of another table of the same database."""
        return replace(self, table=table)

    @property
    def user_and_password(self) -> tuple[str, str]:
        """Return InfluxDB's user and password; the user is "" for a token, which is then the password.

        They come from the environment's variables USER and PASSWORD (names held here), or else from the URL. Both are
        "" if there is none.
        """
        parts = urlsplit(self.url)
        user = os.environ.get(USER) or unquote(parts.username or "")
        return user, os.environ.get(PASSWORD) or unquote(parts.password or "")


def is_store(location: object) -> bool:
    """Return whether a text is the URL of a store, and not the name of a file."""
    return isinstance(location, str) and location.split("://")[0] in (*INFLUX, *POSTGRES) and "://" in location


ASKED = "one of table=NAME and query=SELECT..."  # what is expected, in errors
ESCAPED = "a user and a password in which / ? # and @ are written %2F %3F %23 and %40"


def parse_store(url: str) -> StoreAddress:
    """Read the URL of a store: SCHEME://user:password@host:port/database?table=NAME, or ...?query=SELECT ....

    What follows `query=`, of InfluxDB also `flux=` or `sql=`, is the statement to its end, & included; a % in it is
    written %25. Of PostgreSQL other parameters, as sslmode=require, are the server's; of InfluxDB 2 org=NAME is known.

    ASKS splits the URL before a statement; ASKED is the text of what is expected.

    Raises:
        ValueError: another kind of URL, no database, both table and query; one line without the password.
    """
    from heliograph.numerics.check import fail, text  # not before a command needs it

    text("store", url)
    # "scheme://.../database?options&", then "query", "flux" or "sql" and the statement; these are "" if there is none.
    location, language, statement = [*ASKS.split(url, maxsplit=1), "", ""][:3]
    parts = _split_location(location)
    database = unquote(parts.path).strip("/")
    is_influx = parts.scheme in INFLUX
    store = f"store {parts.scheme}://{parts.hostname or ''}/{database}"  # for errors
    # The options before the statement. A URL has one table or one statement, in a language that the server has.
    table, organisation = _read_options(store, parts.query, is_influx, has_statement=bool(language))
    if language and not statement.strip():
        raise fail(store, ASKED, "both, or one without a value")
    if not is_influx and language not in ("", "query"):
        raise fail(store, "query=SELECT..., as InfluxDB alone has others", language)
    # PostgreSQL gets its own options in the URL; those of InfluxDB have been read.
    kept = [option for option in parts.query.split("&") if not is_influx and not option.startswith("table=")]
    return StoreAddress(
        kind=parts.scheme,
        url=urlunsplit((parts.scheme, parts.netloc, parts.path, "&".join(kept), "")),
        database=database,
        table=table,
        query=unquote(statement),
        language=cast(Language, language or "query"),
        organisation=organisation,
    )


def _split_location(location: str) -> SplitResult:
    """Return the parts of a store's URL without its statement: scheme, host, path (the database) and options (`query`).

    INFLUX and POSTGRES are the known schemes; ESCAPED and SHAPE are texts of what is expected.

    Raises:
        ValueError: another scheme, no database, no host of InfluxDB, an @ or / of a password that is not escaped.
    """
    from heliograph.numerics.check import fail

    try:
        parts = urlsplit(location)
        host, _port = parts.hostname, parts.port  # reading `port` raises ValueError if it is no number
    except ValueError:
        raise fail("store", ESCAPED if "@" in location else SHAPE, "an address that cannot be read") from None
    if "@" in parts.path:  # the first / ends the host: the / belongs to a user or a password
        raise fail("store", ESCAPED, "an address with an @ behind its first /")
    has_database = bool(unquote(parts.path).strip("/"))
    lacks_host = parts.scheme in INFLUX and not host
    if parts.scheme not in (*INFLUX, *POSTGRES) or not has_database or lacks_host:
        raise fail("store", SHAPE, f"{parts.scheme}://{host or ''}{parts.path}")
    return parts


def _read_options(store: str, options: str, is_influx: bool, has_statement: bool) -> tuple[str, str]:
    """Return (table, organisation) that the options of a URL name; "" for one that they do not name.

    Args:
        store: the store, for errors.
        options: the options, such as "table=NAME&org=NAME". Other options of PostgreSQL are ignored here: the server
            gets them.
        is_influx: whether the store is InfluxDB, which has no other options than these two.
        has_statement: whether the URL has a statement (a query); then no table may be named.

    Raises:
        ValueError: another option of InfluxDB, several tables, or a table beside a statement.
    """
    from heliograph.numerics.check import fail

    # Split the options into the table's and the others, of which InfluxDB's organisation is taken out.
    decoded = [unquote(option) for option in options.split("&") if option]
    tables = [option.removeprefix("table=") for option in decoded if option.startswith("table=")]
    others = [option for option in decoded if not option.startswith("table=")]
    organisation = ""
    if is_influx and len(others) == 1 and others[0].startswith("org="):
        organisation = others.pop().removeprefix("org=")
    if is_influx and others:
        raise fail(store, ASKED, others[0].split("=")[0])
    if has_statement and tables:
        raise fail(store, ASKED, "both, or one without a value")
    if len(tables) > 1:
        raise fail(store, ASKED, "several")
    return (tables[0] if tables else ""), organisation
