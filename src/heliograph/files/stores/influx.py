"""InfluxDB over HTTP: InfluxQL in, line protocol out, by the two endpoints that versions 1, 2 and 3 all have.

Those are /query and /write (of 2 and 3 their "1.x compatibility"): a bucket or database by its name, a token as
`Authorization: Token`, or user and password.
"""

import json
import re
from base64 import b64encode
from collections.abc import Iterator, Mapping
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from math import isfinite
from typing import Any
from urllib.parse import urlencode, urlsplit

import numpy as np

from heliograph.files.stores.address import StoreAddress
from heliograph.numerics.check import InputError, fail

PORT = 8086
SECONDS = 60.0  # until a server must answer
BATCH = 4 * 2**20  # bytes of one request: a server may refuse more than ten million
SAID = 200  # characters of what a server says


def ask_influx(address: StoreAddress) -> tuple[str, dict[str, Any]]:
    """Ask for a table; return the measurement's name and its columns: lists, and `time` as datetime64[ns].

    Several series, as of GROUP BY, are one table in the order of time, with their tags as columns.

    Raises:
        ValueError: the server is away or refuses, or nothing came; one line.
    """
    query = address.query or f'SELECT * FROM "{_escape(address.table, chr(34))}"'
    answer = _send(address, "GET", f"/query?{urlencode({'db': address.database, 'q': query, 'epoch': 'ns'})}")
    try:
        results = json.loads(answer)["results"]
    except (ValueError, KeyError, TypeError):
        raise fail(str(address), "an answer of InfluxDB in JSON", repr(answer[:40])) from None
    refused = next((each["error"] for each in results if "error" in each), None)
    if refused is not None:
        raise fail(str(address), "a query that it answers", _shorten(str(refused)))
    series = [part for each in results for part in each.get("series", ())]
    if any(part.get("partial") for part in (*results, *series)):
        raise fail(str(address), "all rows of the query", "a part of them, as the server limits their number")
    if not series:
        raise fail(str(address), "a query with rows", "none")
    return str(series[0].get("name", address.table)), _join_series(address, series)


def _join_series(address: StoreAddress, series: list[dict[str, Any]]) -> dict[str, Any]:
    """Return series as the columns of one table, in the order of time where there are several."""
    rows = [
        {**part.get("tags", {}), **dict(zip(part["columns"], values, strict=True))}
        for part in series
        for values in part["values"]
    ]
    names = list(dict.fromkeys(name for part in series for name in (*part["columns"], *part.get("tags", {}))))
    if "time" not in names:
        raise fail(str(address), "a query that returns time", f"the columns {', '.join(names)}")
    if len(series) > 1:
        rows.sort(key=lambda row: row["time"])
    columns: dict[str, Any] = {name: [row.get(name) for row in rows] for name in names}
    columns["time"] = np.array(columns["time"], dtype=np.int64).view("datetime64[ns]")
    return columns


def write_influx(address: StoreAddress, columns: Mapping[str, np.ndarray], moments: np.ndarray, plant: str) -> None:
    """Write the rows of a table as points of its moments (datetime64[ns]); what is not finite is left out.

    A point of the same moment and plant is replaced, so that what was interrupted is written anew by the same call.

    Raises:
        ValueError: the server is away or refuses; one line that says how many rows are there.
    """
    target = f"/write?{urlencode({'db': address.database, 'precision': 'ns'})}"
    done = 0
    for body, rows in _batch_lines(address.written_table, columns, moments, plant):
        try:
            _send(address, "POST", target, body)
        except InputError as error:
            if not done:
                raise
            raise InputError(
                f"{error}; {done} rows of {len(moments)} are written: the same again replaces them"
            ) from None
        done += rows


def check_influx(address: StoreAddress) -> None:
    """Raise ValueError where no server answers there."""
    _send(address, "GET", "/ping")


def _batch_lines(
    table: str, columns: Mapping[str, np.ndarray], moments: np.ndarray, plant: str
) -> Iterator[tuple[bytes, int]]:
    """Yield lines of the protocol in requests of a bounded size, each with its number of rows."""
    key = _escape(table, ", ") + (f",plant={_escape(plant, ', =')}" if plant else "")
    names = [_escape(name, ", =") for name in columns]
    lines, size, rows = list[str](), 0, 0
    for time, *cells in zip(moments.astype(np.int64).tolist(), *(c.tolist() for c in columns.values()), strict=True):
        fields = ",".join(f"{n}={_print_value(v)}" for n, v in zip(names, cells, strict=True) if isfinite(v))
        rows += 1
        if fields:
            lines.append(f"{key} {fields} {time}\n")
            size += len(lines[-1])
        if size > BATCH:
            yield "".join(lines).encode(), rows
            lines, size, rows = [], 0, 0
    if lines:
        yield "".join(lines).encode(), rows


def _print_value(value: bool | float) -> str:
    """Return a number with all its digits, or true or false."""
    return str(value).lower() if isinstance(value, bool) else repr(float(value))


def _escape(name: str, signs: str) -> str:
    return re.sub(f"([{re.escape(signs)}])", r"\\\1", name)


def _send(address: StoreAddress, method: str, target: str, body: bytes | None = None) -> bytes:
    """Send one request; return the body of the answer.

    Raises:
        ValueError: no answer, or one that refuses; one line.
    """
    parts = urlsplit(address.url)
    kind = HTTPSConnection if address.kind == "influxs" else HTTPConnection
    connection = kind(parts.hostname or "", parts.port or PORT, timeout=SECONDS)
    try:
        connection.request(method, target, body, _authorize(address))
        answer = connection.getresponse()
        content, status = answer.read(), answer.status
    except (OSError, HTTPException) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise fail(str(address), "a server that answers", _shorten(why)) from None
    finally:
        connection.close()
    if status >= 300:
        raise fail(str(address), "a server that accepts this", f"{status} {_explain_refusal(content)}".rstrip())
    return content


def _authorize(address: StoreAddress) -> dict[str, str]:
    """Return the header that names who asks: a user with his password, or a token alone."""
    user, password = address.login
    if user:
        return {"Authorization": "Basic " + b64encode(f"{user}:{password}".encode()).decode()}
    return {"Authorization": f"Token {password}"} if password else {}


def _explain_refusal(content: bytes) -> str:
    """Return what a server says in its answer: of JSON its error or message."""
    said = content.decode(errors="replace")
    try:
        found = json.loads(said)
    except ValueError:
        return _shorten(said)
    return _shorten(str(found.get("error") or found.get("message") or said) if isinstance(found, dict) else said)


def _shorten(said: str) -> str:
    line = " ".join(said.split())
    return line if len(line) <= SAID else f"{line[:SAID]}..."
