"""Parts that other packages bring, found by entry points: brokers and formats of one's own."""

from importlib.metadata import entry_points
from typing import Any

from heliograph.numerics.check import fail

BROKERS, FORMATS = "heliograph.brokers", "heliograph.formats"  # groups of entry points


def find_plugin(group: str, name: str) -> Any | None:
    """Return what an installed package offers under a name, loaded, or None if no package offers it.

    Args:
        group: group of entry points.
        name: for a broker the scheme of its URLs, for a format the suffix of its files without the dot.

    Raises:
        ValueError: two packages offer it, or it cannot be imported; one line.
    """
    entries = {entry.value: entry for entry in entry_points(group=group, name=name)}
    if len(entries) > 1:
        raise fail(f"{group}, {name}", "one package that offers it", " and ".join(sorted(entries)))
    for import_path, entry in entries.items():
        try:
            return entry.load()
        except (ImportError, AttributeError) as error:
            raise fail(f"{group}, {name}", f"{import_path}, which can be imported", f"{error}") from None
    return None
