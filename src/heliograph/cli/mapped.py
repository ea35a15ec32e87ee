"""Recordings that a command reads by the sources of a network's file."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from heliograph.files.event_table import EventTable
    from heliograph.report.progress import Advance
    from heliograph.simulation.network import Network


def read_mapped(
    measurements: Path, reference: str, network: "Network", module: Mapping[str, object], advance: "Advance"
) -> "EventTable | None":
    """Read the messages of a bag, or of a CSV file of which the sources name the topics; None for any other table."""
    from heliograph.files.messages import is_mapped, read_messages
    from heliograph.numerics.check import fail

    sources = module.get("sources")
    if not is_mapped(measurements, sources):
        return None
    if sources is None:
        hint = f"heliograph inspect {measurements} --network {reference} suggests them"
        raise fail(f"network {reference}", f"sources, for the topics of {measurements} ({hint})", "none")

    def progress(done: int, total: int) -> None:
        advance(f"reading {measurements.name}", done, total)

    return read_messages(measurements, network, sources, progress)
