"""A reproduction run once for all tests of it: what it computes, and the folder that it writes of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import pytest


@contextmanager
def kept(run: ModuleType) -> Iterator[tuple[list[Any], pytest.MonkeyPatch]]:
    """Within, what `run.reproduce` computes goes to the list as well, and sizes may be patched."""
    found: list[Any] = []
    results = run.results

    def told(result: Any) -> Any:
        found.append(result)
        return results(result)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "results", told)
        yield found, patch
