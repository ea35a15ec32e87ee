"""What the modules of this folder share and let go: programs compiled for worlds.py, connections to databases."""

from collections.abc import Iterator
from importlib.util import find_spec

import pytest

from tests.conftest import forget


@pytest.fixture(scope="package", autouse=True)
def forget_compiled_programs() -> Iterator[None]:
    """Only after the last of them."""
    yield
    forget()


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
