"""What the modules of this folder let go: connections to databases."""

from collections.abc import Iterator
from importlib.util import find_spec

import pytest


@pytest.fixture(autouse=True)
def no_connection_stays_open() -> Iterator[None]:
    """A service that dies in a test closes nothing; Python 3.13 warns of a connection that is let go open."""
    if find_spec("sqlalchemy") is None:
        yield
        return
    from sqlalchemy import Pool, event

    opened = []

    def keep(connection, record):
        opened.append(connection)

    event.listen(Pool, "connect", keep)
    yield
    event.remove(Pool, "connect", keep)
    for connection in opened:
        connection.close()
