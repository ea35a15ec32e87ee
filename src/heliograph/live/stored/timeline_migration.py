"""Carrying a saved timeline over to a network that has changed."""

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import shared_program
from heliograph.live.stored.migration import PlantMigration, describe_network
from heliograph.live.stored.network_changes import DESCRIPTION, SAME
from heliograph.live.stored.snapshot import check_same_network
from heliograph.numerics.check import fail
from heliograph.simulation.network import Network


def carry_over_timeline(
    network: Network, head: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the arrays of a snapshot of another network or version as this network would have saved them.

    A snapshot has a plant's live rows, and final rows (which do not change any more) that were not read yet. If the
    network has changed, states are moved to where it has them now. It warns of each change, and of final rows that
    cannot be carried over.

    Args:
        network: the network as it is now.
        head: head of the snapshot: its options, and the identity of the network that saved it.
        arrays: its arrays: "plant", the plant's bytes; "final.time" and "final", rows not yet read.

    Raises:
        ValueError: nothing can be carried over.
    """
    # Identities of both networks (texts that differ if the networks do), with a description of where states stand.
    window, ahead, capacity = head["options"]
    fleet = Fleet(shared_program(network), Options(window, ahead, capacity=capacity), alone=True)
    mine, other = fleet.program.identity | {DESCRIPTION: describe_network(fleet)}, head["of"]
    # A version before 0.3.0 did not write where states stand: it is known for the same nodes and filters.
    if DESCRIPTION not in head:
        check_same_network("snapshot", mine, other, (*SAME, "nodes", "filters"), accept=True)
    other = other | {DESCRIPTION: head.get(DESCRIPTION) or describe_network(fleet, covariances=True)}
    # `migration` translates rows of the other network to rows of this one; it warns of each change.
    migration = PlantMigration(fleet, mine, lambda line: warnings.warn(f"timeline, {line}", stacklevel=5))
    migration.begin("snapshot", other)
    plant = _migrate_plant(migration, arrays["plant"])
    time, final = arrays["final.time"], migration.migrate_outputs(arrays["final"])
    if final is None:
        said = f"timeline, snapshot: {len(time)} final rows are estimates of other filters, and not carried on"
        warnings.warn(said, stacklevel=4)
        time, final = np.zeros(0), np.zeros((0, fleet.state_table.step_rows.outputs.size))
    return {"plant": plant, "final.time": time, "final": final}


def _migrate_plant(migration: PlantMigration, plant: np.ndarray) -> np.ndarray:
    """Return the bytes of a timeline's plant as this network stores them; raise ValueError if they cannot be read."""
    name = ""  # a timeline's only plant has no name
    try:
        migrated = migration.migrate({name: plant.tobytes()})
    except ValueError as error:
        raise fail("snapshot", "rows of the filters that are here", f"other ones: {error}") from None
    return np.frombuffer(migrated[name], np.uint8)
