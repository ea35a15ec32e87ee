"""InfluxDB over HTTP: InfluxQL in, line protocol out, by the two endpoints that versions 1, 2 and 3 all have.

Those are /query and /write (of 2 and 3 their "1.x compatibility"): a bucket or database by its name, a token as
`Authorization: Token`, or user and password. Flux is asked at version 2's own endpoint, SQL at that of version 3.
"""

import json
import re
import warnings
from base64 import b64encode
from collections.abc import Iterator, Mapping
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from math import isfinite
from typing import Any
from urllib.parse import urlencode, urlsplit

import numpy as np

from heliograph.files.stores.influx_responses import (
    parse_flux_response,
    parse_influxql_response,
    parse_sql_response,
    shorten_answer,
)
from heliograph.files.stores.store_address import StoreAddress
from heliograph.numerics.check import InputError, fail

PORT = 8086
SECONDS = 60.0  # until a server must answer
BATCH = 4 * 2**20  # bytes of one request: a server may refuse more than ten million


def query_influx(address: StoreAddress) -> tuple[str, dict[str, Any]]:
    """Ask a server for a table; return the measurement's name and the columns as lists, `time` as datetime64[ns].

    The statement in the address is asked in its language; without one all of the address's table is asked for, in
    InfluxQL. Several series, as from GROUP BY, become one table sorted by time, with their tags as columns.
    `_send_request` returns the body of the answer. A parser makes of it the name and the columns.

    Raises:
        ValueError: the server does not answer or refuses, or nothing came.
    """
    query = address.query or f'SELECT * FROM "{_escape_name(address.table, signs=chr(34))}"'  # chr(34) is "
    match address.language:
        case "flux":
            return parse_flux_response(address, _send_request(address, "POST", *_make_flux_request(address)))
        case "sql":
            target = urlencode({"db": address.database, "q": query, "format": "json"})
            return parse_sql_response(address, _send_request(address, "GET", f"/api/v3/query_sql?{target}"))
    answer = _send_request(address, "GET", f"/query?{urlencode({'db': address.database, 'q': query, 'epoch': 'ns'})}")
    return parse_influxql_response(address, answer)


def _make_flux_request(address: StoreAddress) -> tuple[str, bytes]:
    """Return the URL's path and the body of a Flux request, which asks for CSV with the type of each column."""
    organisation = f"?{urlencode({'org': address.organisation})}" if address.organisation else ""
    dialect = {"header": True, "delimiter": ",", "annotations": ["datatype"]}
    body = {"query": address.query, "type": "flux", "dialect": dialect}
    return f"/api/v2/query{organisation}", json.dumps(body).encode()


def write_influx(address: StoreAddress, columns: Mapping[str, np.ndarray], moments: np.ndarray, plant: str) -> None:
    """Write the rows of a table as points at `moments` (datetime64[ns]); numbers that are not finite are left out.

    InfluxDB replaces a point of the same moment and plant, so an interrupted call can simply be repeated. For the same
    reason only the last of several rows of one moment stays, and a warning says how many rows are lost so.

    Args:
        address: the server, its database, and the table for estimates.
        columns: values of each column by its name, (rows,) each.
        moments: time of each row (rows,).
        plant: name of the plant, by which its points are told from others'.

    Raises:
        ValueError: the server does not answer or refuses. The error says how many rows are written.
    """
    target = f"/write?{urlencode({'db': address.database, 'precision': 'ns'})}"
    replaced = len(moments) - len(np.unique(moments))
    if replaced:
        warnings.warn(
            f"{address}: {replaced} of {len(moments)} rows are replaced by a later row of the same time, of which a "
            "measurement has one point",
            stacklevel=2,
        )
    # One request a batch of lines. `done` counts the rows that are written before an error.
    done = 0
    for body, rows in _batch_protocol_lines(address.table_for_estimates, columns, moments, plant):
        try:
            _send_request(address, "POST", target, body)
        except InputError as error:
            if not done:
                raise
            raise InputError(
                f"{error}; {done} rows of {len(moments)} are written: the same again replaces them"
            ) from None
        done += rows


def check_influx(address: StoreAddress) -> None:
    """Raise ValueError unless a server answers at the address."""
    _send_request(address, "GET", "/ping")


def _batch_protocol_lines(
    table: str, columns: Mapping[str, np.ndarray], moments: np.ndarray, plant: str
) -> Iterator[tuple[bytes, int]]:
    """Yield (body, rows): bodies of requests of about BATCH bytes in line protocol, each with its number of rows.

    A line is "TABLE,plant=PLANT NAME=VALUE,... NANOSECONDS". A row without any finite number has no line, but counts.
    `columns`: values by name (rows,). `moments`: times of the rows. `_escape_name` puts backslashes before signs that
    would end a name.
    """
    key = _escape_name(table, ", ") + (f",plant={_escape_name(plant, ', =')}" if plant else "")
    names = [_escape_name(name, ", =") for name in columns]
    lines, size, rows = list[str](), 0, 0
    for time, *cells in zip(moments.astype(np.int64).tolist(), *(c.tolist() for c in columns.values()), strict=True):
        fields = ",".join(f"{n}={_format_value(v)}" for n, v in zip(names, cells, strict=True) if isfinite(v))
        rows += 1
        if fields:  # a point without fields is none
            lines.append(f"{key} {fields} {time}\n")
            size += len(lines[-1])
        if size > BATCH:
            yield "".join(lines).encode(), rows
            lines, size, rows = [], 0, 0
    if lines:
        yield "".join(lines).encode(), rows


def _format_value(value: bool | float) -> str:
    """Return a number as line protocol writes it: a float with all its digits, or true or false."""
    return str(value).lower() if isinstance(value, bool) else repr(float(value))


def _escape_name(name: str, signs: str) -> str:
    """Return a name with a backslash before each of the characters in `signs`, which would otherwise end it."""
    return re.sub(f"([{re.escape(signs)}])", r"\\\1", name)


def _send_request(address: StoreAddress, method: str, target: str, body: bytes | None = None) -> bytes:
    """Return the body of a server's answer to one request.

    A request has a connection of its own, by HTTPS for an address "influxs", and is given up after SECONDS seconds.

    Args:
        address: the server.
        method: "GET" or "POST".
        target: path and query of the request.
        body: what is sent, None for nothing.

    Raises:
        ValueError: no answer, or one that refuses; one line.
    """
    parts = urlsplit(address.url)
    kind = HTTPSConnection if address.kind == "influxs" else HTTPConnection
    connection = kind(parts.hostname or "", parts.port or PORT, timeout=SECONDS)
    try:
        connection.request(method, target, body, _make_headers(address))
        answer = connection.getresponse()
        content, status = answer.read(), answer.status
    except (OSError, HTTPException) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise fail(str(address), "a server that answers", shorten_answer(why)) from None
    finally:
        connection.close()
    if status >= 300:
        raise fail(str(address), "a server that accepts this", f"{status} {_explain_refusal(content)}".rstrip())
    return content


def _make_headers(address: StoreAddress) -> dict[str, str]:
    """Return the headers of a request: the user and password or the token, and for Flux also the content types.

    `address`: the server, with the language of its query.
    """
    user, password = address.user_and_password
    if address.language == "flux":
        token = f"{user}:{password}" if user else password  # version 1 takes both as one token
        kinds = {"Content-Type": "application/json", "Accept": "application/csv"}
        return kinds | ({"Authorization": f"Token {token}"} if token else {})
    if user:
        return {"Authorization": "Basic " + b64encode(f"{user}:{password}".encode()).decode()}
    # Version 3, which is asked in SQL, takes a bearer token; versions 1 and 2 their own word for it.
    scheme = "Bearer" if address.language == "sql" else "Token"
    return {"Authorization": f"{scheme} {password}"} if password else {}


def _explain_refusal(content: bytes) -> str:
    """Return a server's reason for refusing: the error or message in its JSON answer, else the whole answer."""
    answer = content.decode(errors="replace")
    try:
        decoded = json.loads(answer)
    except ValueError:
        decoded = None
    reason = decoded.get("error") or decoded.get("message") if isinstance(decoded, dict) else None
    return shorten_answer(str(reason or answer))
