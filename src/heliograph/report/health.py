"""Diagnosis of a network from a recording: reliability of its links, and tests of its filters' claims."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from heliograph.report.outputs import OutputHealth, listeners, outputs_of
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.whiteness import MemoryTest, memory_of, whitened_innovations

LAGS = 10  # of the test for memory, with ten rows for each at least
FALSE = 0.01  # probability of a false warning by one kind of test, of all filters together


@dataclass(frozen=True)
class Link:
    """One component of a node's measurement: whether it arrived (time,), and the values that did."""

    node: str
    component: str
    arrived: np.ndarray
    values: np.ndarray
    loses: bool  # whether the network says that it may be lost

    @property
    def share(self) -> float:
        """Return the share of rows in which it arrived."""
        return float(self.arrived.mean())

    @property
    def longest_gap(self) -> int:
        """Return the greatest number of consecutive rows without it."""
        ends = np.flatnonzero(np.concatenate([[True], self.arrived, [True]]))
        return int(np.max(np.diff(ends)) - 1)


@dataclass(frozen=True)
class FilterHealth:
    """Innovations of one filter in units of its claim (time, m), and the test of their whiteness.

    Both are None for a filter without a claim, the test also if there are too few rows.
    """

    node: str
    filter: str
    claim: str
    white: np.ndarray | None
    test: MemoryTest | None
    trusted: bool = True  # whether the network relies on it


@dataclass(frozen=True)
class Health:
    """A record, with the diagnosis of links and filters."""

    record: Record
    links: list[Link]
    filters: list[FilterHealth]
    outputs: list[OutputHealth]  # by filter that claims a covariance
    shared: dict[str, tuple[str, ...]]  # by its name, what several nodes share

    def warnings(self) -> list[str]:
        """Return one line for each reason to doubt the network."""
        lines = list(self.record.failures())
        for link in self.links:
            name = f"{link.node}: {link.component}"
            if not link.arrived.any():
                lines.append(f"{name} never arrived")
            elif not link.loses and link.share < 1:
                lines.append(
                    f"{name} is missing in {1 - link.share:.1%} of the rows; the network says that it is never lost"
                )
        for doubted in self.doubted():
            lines += self._doubts(doubted)
        return lines

    def doubted(self) -> list[FilterHealth]:
        """Return the filters that the network relies on and whose claims the recording contradicts."""
        return [filter for filter in self.filters if filter.trusted and any(self._doubts(filter))]

    def remarks(self) -> list[str]:
        """Return one line for each doubt about a filter that is there to be compared with."""
        return [line for filter in self.filters if not filter.trusted for line in self._doubts(filter)]

    def _doubts(self, health: FilterHealth) -> Iterator[str]:
        if health.test is None:
            return
        name, test = f"{health.node}/{health.filter}", health.test
        # Many filters are tested: each at a level at which all together are seldom wrong (Bonferroni). The logarithm
        # of a mean square is nearly Gaussian, with its relative error; one that came out small has a small error too.
        level = FALSE / sum(filter.test is not None for filter in self.filters)
        sure = -ndtri(level / 2) * test.power_error / test.power
        if np.log(test.power) > sure:
            yield (
                f"{name} is too sure: the mean square of its innovations is {test.power:.2f} times what it claims; "
                "the model leaves something out"
            )
        elif np.log(test.power) < -sure:
            yield f"{name} is too cautious: the mean square of its innovations is {test.power:.2f} times what it claims"
        if test.p_value < level:
            yield (
                f"{name} could know more: its innovations are correlated over one step ({test.correlation[0]:.2f}); "
                "links or the plant remember what the model forgets"
            )


def examine(
    network: Network, record: Record, inputs: np.ndarray, advance: Callable[[str], object] = lambda what: None
) -> Health:
    """Diagnose links and filters of a recording that was run through the network."""
    received = record.measurements
    # Links: when each component arrived.
    links = []
    for node in received:
        z, receiver = received[node], network.nodes[node]
        for i, name in enumerate(receiver.received_names):
            there = ~np.isnan(z[:, i])
            links.append(Link(node, name, there, z[there, i], not receiver.complete))
    # Filters: innovations whitened by their claimed covariance, S^(-1/2) e, and their correlations over time.
    filters, outputs = [], []
    for listener in listeners(network, record):
        node, name, filter, z = listener[:4]
        advance(f"testing {node}/{name}")
        white = None
        if filter.claim != "none" and filter.received:
            white = whitened_innovations(z, filter, inputs)
            outputs += outputs_of(listener, record, inputs)
        lags = min(LAGS, len(z) // 10)
        enough = white is not None and lags > 0 and np.count_nonzero(~np.isnan(white)) > LAGS
        test = memory_of(white, lags, claimed=True) if white is not None and enough else None
        lost = np.any(record.estimates[node][name].claims == "none")
        filters.append(FilterHealth(node, name, "none" if lost else filter.claim, white, test, listener.trusted))
    return Health(record, links, filters, outputs, network.shared)
