"""What users of a fleet should read once: remarks of filters on their states, and sensors that seem stuck."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from heliograph.live.fleet import Fleet
from heliograph.live.plant_state import PlantState
from heliograph.live.sorted_rows import HeldRow


class RemarkWatch:
    """Watch for what filters say of their states, by the newest row of each plant.

    A late event may make a row anew, so that what was said never happened; it is counted all the same, and what happens
    in its place is not said again. `counts` has how often each filter's state has been spoken of, over all plants, by
    node and filter.
    """

    def __init__(self, fleet: Fleet):
        """Begin with counts of zero for each filter of the fleet that can remark on its state."""
        self._state_table, self._steps = fleet.state_table, fleet.program.step_rows
        self.counts = Counter[tuple[str, str]](dict.fromkeys(self._steps.remarking, 0))

    def find_new(self, plants: Iterable[PlantState]) -> Iterator[tuple[str, str]]:
        """Yield (name of the plant, line) for each new remark of a filter on its state.

        A filter's state counts how often the filter made its remark (`remark.times`). A remark is new if that is more
        than was passed on before, which `plant.remarked` has by (node, filter); `counts` sums this over all plants.
        """
        for plant in plants if self.counts else ():
            newest_row = plant.rows.held[-1]
            for (node, filter), remark in self._read_remarks(newest_row).items():
                count_of_new = remark.times - plant.remarked.get((node, filter), 0)
                if count_of_new > 0:
                    self.counts[node, filter] += count_of_new
                    plant.remarked[node, filter] = remark.times
                    yield plant.name, f"{node}/{filter}: {remark.words}"

    def note_said(self, plant: PlantState) -> None:
        """Note that all remarks on a plant were made before it was stored, so that none is made again."""
        plant.remarked = {filter: said.times for filter, said in self._read_remarks(plant.rows.held[-1]).items()}

    def _read_remarks(self, row: HeldRow) -> dict[tuple[str, str], Any]:
        """Return the remark of each filter on its state after a row, by node and filter.

        A remark has `words`, and `times`: how often it was made. Filters that can never make one have none; `counts`
        has the others.
        """
        if not self.counts:
            return {}
        return self._steps.read_remarks(self._state_table.table[row.slot, self._state_table.state])


class FleetRepeatWatch:
    """Watch for outputs that repeat for longer than their noise allows; each is said once, of one plant."""

    def __init__(self, fleet: Fleet):
        """Hold the watches of all plants' outputs, of which none was warned of yet."""
        self._watches, self._nodes = fleet.held_watches, fleet.network.nodes
        self._said = set[tuple[str, int]]()  # node and output

    def find_new(self, plants: Iterable[PlantState]) -> Iterator[tuple[str, str]]:
        """Yield (name of the plant, line) for each output that has repeated for too long for the first time.

        An output of a node is named once, by the first plant in which this is found. `link.repeats.found` counts for
        each output the runs of equal readings that were too long.
        """
        for plant in plants if self._watches else ():
            for node, link in plant.links.items():
                stuck_outputs = [output for output, count in enumerate(link.repeats.found) if count]
                for output in stuck_outputs:
                    if (node, output) not in self._said:
                        self._said.add((node, output))
                        name = self._nodes[node].received_names[output]
                        warning = self._watches[node].describe_stuck_output(output, name, link.repeats)
                        yield plant.name, f"{node}: {warning}"
