"""What is compiled for the networks of worlds.py serves all modules of this folder."""

from collections.abc import Iterator

import pytest

from tests.conftest import forget


@pytest.fixture(scope="package", autouse=True)
def forget_compiled_programs() -> Iterator[None]:
    """Only after the last of them."""
    yield
    forget()
