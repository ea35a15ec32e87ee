"""Packets as a network delivered them, and what that says of the network: losses, order, copies, delays."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heliograph.numerics.check import fail

FALL = 50  # a sequence number that falls by more, or to RESTART at most, tells of a reboot; less are swapped neighbours
RESTART = 3


@dataclass(frozen=True)
class Packets:
    """One entry for each packet that was received, in the order of arrival, copies too.

    Shapes (packet,): node and sequence, whole numbers; sent and received in seconds since the first was sent.
    """

    node: np.ndarray
    sequence: np.ndarray
    sent: np.ndarray
    received: np.ndarray

    def __len__(self) -> int:
        return len(self.node)

    def among(self, which: np.ndarray) -> "Packets":
        """Some of them."""
        return Packets(self.node[which], self.sequence[which], self.sent[which], self.received[which])

    def first_received(self) -> np.ndarray:
        """Whether each is the first with its node, sequence and time; numbers come again after a reboot."""
        known = set[tuple[int, int, float]]()
        result = np.zeros(len(self), dtype=bool)
        for i, name in enumerate(zip(self.node.tolist(), self.sequence.tolist(), self.sent.tolist(), strict=True)):
            result[i] = name not in known
            known.add(name)
        return result

    def boots(self) -> "list[Packets]":
        """Without copies, sorted by the time of sending: one part for each boot of each node."""
        local, parts = self.among(self.first_received()), list[Packets]()
        for node in np.unique(local.node):
            mine = np.flatnonzero(local.node == node)
            mine = mine[np.argsort(local.sent[mine], kind="stable")]
            step = np.diff(local.sequence[mine])
            again = (step < -FALL) | ((step < 0) & (local.sequence[mine][1:] <= RESTART))
            parts += [local.among(part) for part in np.split(mine, np.flatnonzero(again) + 1)]
        return parts

    def fates(self) -> "list[np.ndarray]":
        """For each boot the delay of every packet that was sent from its first to its last, NaN if it was lost."""
        return [_fates(part) for part in self.boots()]


def _fates(part: Packets) -> np.ndarray:
    low = int(part.sequence.min())
    result = np.full(int(part.sequence.max()) - low + 1, np.nan)
    result[part.sequence - low] = part.received - part.sent
    return result


@dataclass(frozen=True)
class Statistics:
    """What is known of a network from its packets; shares are of one.

    lost: of those sent; runs of losses, their mean and the longest; lost_after_lost: of those after a loss.
    out_of_order: of those received, after one that was sent later, from anywhere or from their own node. copies: of all
    that was received. delay: median, 95 % and largest, seconds. interval: between packets of a node, seconds.
    """

    packets: int
    nodes: int
    boots: int
    lost: float
    run_mean: float
    run_max: int
    lost_after_lost: float
    out_of_order: float
    out_of_order_by_node: float
    copies: float
    delay_median: float
    delay_95: float
    delay_max: float
    interval: float


def statistics(packets: Packets) -> Statistics:
    """Of a network's packets."""
    fates = [np.isnan(fate) for fate in packets.fates()]
    runs = np.concatenate([_runs(lost) for lost in fates])
    # Losses after a loss: each packet and the next of one boot.
    before, after = (np.concatenate([lost[part] for lost in fates]) for part in (slice(None, -1), slice(1, None)))
    local = packets.among(packets.first_received())
    by_node = [local.sent[local.node == node] for node in np.unique(local.node)]
    delay = local.received - local.sent
    sent = sum(map(len, fates))
    return Statistics(
        packets=len(local),
        nodes=len(by_node),
        boots=len(fates),
        lost=sum(int(lost.sum()) for lost in fates) / sent,
        run_mean=float(runs.mean()) if len(runs) else 0.0,
        run_max=int(runs.max(initial=0)),
        lost_after_lost=float(after[before].mean()) if before.any() else 0.0,
        out_of_order=float(_overtaken(local.sent).mean()),
        out_of_order_by_node=float(np.concatenate([_overtaken(sent) for sent in by_node]).mean()),
        copies=1 - len(local) / len(packets),
        delay_median=float(np.median(delay)),
        delay_95=float(np.quantile(delay, 0.95)),
        delay_max=float(delay.max()),
        interval=float(np.ptp(local.sent) * len(by_node) / sent),
    )


def _overtaken(sent: np.ndarray) -> np.ndarray:
    """Of all but the first: whether one that was sent later was received before."""
    return sent[1:] < np.maximum.accumulate(sent)[:-1]


def _runs(lost: np.ndarray) -> np.ndarray:
    """Lengths of the runs of losses."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    return edges[1::2] - edges[::2]


NODES = 10
INTERVAL = 4.8  # s
LOST, LOST_AFTER_LOST = 0.099, 0.27
COPIES = 0.15
SHARES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 1.0)
DELAYS = (0.015, 0.075, 0.21, 0.38, 0.65, 1.2, 2.2, 4.2, 5.9, 7.8, 23.0, 85.0)  # s at these shares, log-linear between


def synthetic_packets(duration: float, seed: int) -> Packets:
    """Packets sent during so many seconds, in the order of arrival."""
    generator = np.random.default_rng(seed)
    parts = [_node(node, duration, generator) for node in range(2, NODES + 2)]
    node, sequence, sent, received = (np.concatenate(part) for part in zip(*parts, strict=True))
    again = generator.random(len(node)) < COPIES / (1 - COPIES)
    later = received[again] + generator.exponential(INTERVAL / NODES, again.sum())
    order = np.argsort(np.concatenate([received, later]), kind="stable")
    node, sequence, sent = (np.concatenate([a, a[again]])[order] for a in (node, sequence, sent))
    return Packets(node, sequence, sent, np.concatenate([received, later])[order])


def _node(node: int, duration: float, generator: np.random.Generator) -> tuple[np.ndarray, ...]:
    """What is received of one node."""
    count = int(duration / INTERVAL)
    sent = (np.arange(count) + generator.random(count)) * INTERVAL
    begin = LOST * (1 - LOST_AFTER_LOST) / (1 - LOST)  # of a loss after none, so that LOST of all are lost
    lost = np.zeros(count, dtype=bool)
    for k, chance in enumerate(generator.random(count)):
        risk = LOST if k == 0 else LOST_AFTER_LOST if lost[k - 1] else begin
        lost[k] = chance < risk
    delay = np.exp(np.interp(generator.random(count), SHARES, np.log(DELAYS)))
    received = ~lost
    return np.full(received.sum(), node), np.flatnonzero(received), sent[received], (sent + delay)[received]


SLOT = 0.015  # seconds
BYTES = 38
ROW = re.compile(r"\[\s*([0-9]{1,3}(?:\s*,\s*[0-9]{1,3})*)\s*\]\t.*")


def read_trace(path: str | Path) -> tuple[Packets, int]:
    """The packets of a log, and the number of rows that are none: cut off, or received before they were sent.

    Raises:
        ValueError: no such file, no text, or no packet in it.
    """
    path = Path(path)
    if not path.is_file():
        raise fail(f"trace {path}", "a file", "a folder" if path.is_dir() else "nothing of that name")
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except UnicodeDecodeError as error:
        raise fail(f"trace {path}", "a log in UTF-8", str(error)) from None
    read = [_row(line) for line in lines]
    rows = [row for row in read if row is not None]
    if not rows:
        first = f"{lines[0][:60]!r} and {len(lines) - 1} like it" if lines else "an empty file"
        raise fail(f"trace {path}", f"rows of {BYTES} bytes in brackets, a tab and a time", first)
    node, sequence, sent, received = np.array(rows).T
    start = sent.min()
    return Packets(node, sequence, (sent - start) * SLOT, (received - start) * SLOT), len(read) - len(rows)


def _row(line: str) -> tuple[int, int, int, int] | None:
    """Node, sequence, and slots of sending and arrival; None if it is no packet."""
    match = ROW.fullmatch(line.strip())
    result = [] if match is None else [int(part) for part in match[1].split(",")]
    if len(result) != BYTES or max(result) > 255:
        return None
    received, sent, sequence = (_number(result[a:b]) for a, b in ((1, 6), (6, 11), (11, 13)))
    node = result[14]
    return (node, sequence, sent, received) if node and sent <= received else None


def _number(part: Sequence[int]) -> int:
    return int.from_bytes(bytes(part), "little")
