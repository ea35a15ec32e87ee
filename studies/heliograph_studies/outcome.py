"""What a study finds, written once as JSON: the fields of its outcome."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, TypeVar

import numpy as np

from heliograph.report.results_folder import Json

T = TypeVar("T")
UNLISTED, INLINE = "unlisted", "inline"
Unlisted = Annotated[T, UNLISTED]  # a field for figures, page and data that the summary does not list
Inline = Annotated[T, INLINE]  # a field whose own fields stand in the summary in its place


def summary(value: object) -> Any:
    """Anything as JSON has it: dataclasses and named tuples by field, arrays as lists, keys as text."""
    if is_dataclass(value) and not isinstance(value, type):
        entries: dict[str, Json] = {}
        for part in fields(value):
            marks, entry = getattr(part.type, "__metadata__", ()), getattr(value, part.name)
            if INLINE in marks:
                entries.update(summary(entry))
            elif UNLISTED not in marks:
                entries[part.name] = summary(entry)
        return entries
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return summary(value._asdict())
    if isinstance(value, Mapping):
        return {_key(key): summary(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [summary(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value


def _key(key: object) -> str:
    return f"{key:g}" if isinstance(key, float) else str(key)
