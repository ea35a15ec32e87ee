"""Fates of packets, 0 arrived, 1 lost, NaN unknown, in stretches between which nothing is known.

A stretch that was chosen to begin and end with an arrival, as between the first and the last sequence number that came,
has ends that are no trials: they arrived since otherwise the stretch would have other ends.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from heliograph.numerics.check import array, check_count, fail, items, rank, table
from heliograph.numerics.types import ArrayLike, Bool, Float, Shaped

Fates = list[Float[np.ndarray, " packets"]]


class CheckedFates(Fates):
    """Stretches as `check_fates` gives them, with CHOSEN for ends that are no trials: they are not checked again."""


LEAST_JUMP = 200  # sequence numbers that leap so far ahead mean a restart, not of as many losses
CHOSEN = 2.0  # of a packet that arrived, and is an end of its stretch for that reason
COPIES_WITHIN = 50  # a number received again may be a copy within so many
FEW_COPIES = 2  # numbers in a row that come again: more are those of a sender that restarted
LARGEST_NUMBER = 2.0**53  # whole numbers up to here are doubles


class BetweenArrivals(np.ndarray):
    """Fates of a stretch that begins and ends where a packet arrived: these ends are no trials, being chosen for it.

    Only the array itself is marked so; its slices, copies and sums are not.
    """

    chosen = False

    def __array_finalize__(self, source: Any) -> None:
        """Leave an array that is derived from another unmarked."""
        self.chosen = False

    @staticmethod
    def of(fates: np.ndarray) -> "BetweenArrivals":
        """Return fates (packets,), marked as a stretch that was chosen to begin and end with an arrival."""
        marked = fates.view(BetweenArrivals)
        marked.chosen = True
        return marked


def find_trials(fate: np.ndarray) -> Bool[np.ndarray, " packets"]:
    """Return which packets say something of losses: those with a known fate, 0 (arrived) or 1 (lost).

    The end of a stretch that was chosen because it arrived (CHOSEN) could not have been lost, and is no trial.
    """
    return np.asarray((fate == 0) | (fate == 1))


def fill_ends(fate: np.ndarray) -> Float[np.ndarray, " packets"]:
    """Return the fates with 0 (arrived) for chosen ends (CHOSEN), so that the packets after these see an arrival."""
    return np.where(fate == CHOSEN, 0.0, fate)


def keep_ends_only(fate: np.ndarray) -> Float[np.ndarray, " packets"]:
    """Return the stretch with 0 (arrived) at its chosen ends, and NaN (unknown) for all packets between them."""
    return np.where(fate == CHOSEN, 0.0, np.nan)


def fates_of_sequence(
    sequence: "Float[ArrayLike, ' packets']", sent: "Float[ArrayLike, ' packets'] | None" = None, jump: int = LEAST_JUMP
) -> Fates:
    """Return fates of the packets of one sender from the sequence numbers that were received: what is missing was lost.

    A number that leaps ahead by `jump` or falls back starts a new stretch (the sender restarted). Copies are dropped:
    one or two numbers again within 50, or all again from a number on. Packets that overtake each other look like
    restarts: with their times of sending they are put in order first, and a copy has number and time of another.

    The first and the last packet of a stretch are its ends because they arrived: they are no trials (for `learn_losses`
    and the laws of losses), though those between them are, given that both arrived.

    Args:
        sequence: sequence numbers in the order of arrival (packets,).
        sent: times of sending (packets,), in any unit; none by default.
        jump: least jump ahead that means a restart; 200 by default.

    Returns:
        For each stretch the fates of its packets, from the first to the last that arrived: 0 arrived, 1 lost.

    Raises:
        ValueError: no packet, numbers that are not whole, times of another length.
    """
    # Numbers have to be whole, and no larger than doubles hold exactly.
    check_count("jump", jump, 2)
    numbers = array("sequence numbers", sequence, (None,))
    if not len(numbers) or np.any(numbers != np.round(numbers)):
        raise fail("sequence numbers", "whole numbers, at least one", "none" if not len(numbers) else "fractions")
    if np.max(np.abs(numbers)) > LARGEST_NUMBER:
        raise fail("sequence numbers", "numbers up to 2^53", f"{numbers[np.argmax(np.abs(numbers))]:g}")
    # In the order of sending where it is known: by time, then by number; equal pairs are copies, of which one stays.
    ordered = numbers.astype(np.int64)
    if sent is not None:
        times = array("times of sending", sent, ordered.shape)
        ordered = np.unique(np.stack([times, numbers]), axis=1)[1].astype(np.int64)
    stretches = _split_at_restarts(ordered, jump, may_be_copies=sent is None)
    return [_mark_gaps(np.array(stretch)) for stretch in stretches]


def _split_at_restarts(received: np.ndarray, jump: int, may_be_copies: bool) -> list[list[int]]:
    """Return the sequence numbers (packets,) as rising stretches, split where the sender restarted.

    `_split_rising` cuts them where a number does not rise; `_are_copies` says whether the repeated numbers of a run are
    copies of ones received before, rather than new after a restart.

    Args:
        received: sequence numbers in the order of arrival.
        jump: a leap ahead by this much or more means a restart.
        may_be_copies: True if repeated numbers may be copies, which are dropped, and no restart.
    """
    stretches: list[list[int]] = [[]]  # the last one grows
    for run in _split_rising(received):
        # Numbers at the beginning of a rising run that are not above the last number of the stretch.
        repeated = [number for number in run if stretches[-1] and number <= stretches[-1][-1]]
        if repeated and not (may_be_copies and _are_copies(repeated, run, stretches[-1])):
            stretches.append([])
            repeated = []
        for number in run[len(repeated) :]:
            if stretches[-1] and number - stretches[-1][-1] >= jump:
                stretches.append([])
            stretches[-1].append(number)
    return [stretch for stretch in stretches if stretch]


def _split_rising(received: np.ndarray) -> list[list[int]]:
    """Return the numbers (packets,) in rising runs, cut where they fall back; of equal ones in a row one stays."""
    numbers = received[np.concatenate([[True], np.diff(received) != 0])]
    return [run.tolist() for run in np.split(numbers, np.flatnonzero(np.diff(numbers) < 0) + 1)]


def _are_copies(again: list[int], run: list[int], stretch: list[int]) -> bool:
    """Return whether repeated numbers at the beginning of a rising run are copies of packets received before.

    Else they are new packets of a sender that restarted its count. Example: after 5, 6, 7, 8 come 7, 8, 9. Then
    `stretch` is [5, 6, 7, 8], `run` is [7, 8, 9] and `again` is [7, 8]. All must be among the last COPIES_WITHIN
    numbers. At most FEW_COPIES are always copies. More are copies if everything from some number on comes again and the
    run then goes on, as from a broker that missed the acknowledgements. This number may not be the first of the
    stretch.
    """
    lately = stretch[-COPIES_WITHIN:]
    if not set(again) <= set(lately):
        return False
    goes_on = len(run) > len(again)
    is_end_of_stretch = again[0] != stretch[0] and stretch[-len(again) :] == again
    return len(again) <= FEW_COPIES or (goes_on and is_end_of_stretch)


def _mark_gaps(received: np.ndarray) -> BetweenArrivals:
    """Return the fates of all packets from the first received number to the last; missing numbers were lost.

    `received`: rising sequence numbers. `BetweenArrivals` marks a stretch whose ends are there because they arrived, so
    that they are no trials.
    """
    fates = np.ones(received[-1] - received[0] + 1)
    fates[received - received[0]] = 0.0
    return BetweenArrivals.of(fates)


def fates_by_node(
    node: "Sequence[object] | Shaped[np.ndarray, ' packets']",
    sequence: "Float[ArrayLike, ' packets']",
    sent: "Float[ArrayLike, ' packets'] | None" = None,
) -> dict[str, Fates]:
    """Return {sender: fates of its packets} for a log of packets, as `fates_of_sequence` finds them.

    Args:
        node: sender of each packet (packets,).
        sequence: sequence numbers in the order of arrival (packets,).
        sent: times of sending (packets,); none by default.

    Raises:
        ValueError: as `fates_of_sequence`; not one node for each number.
    """
    items("names of nodes", node, "names")
    names = np.asarray([str(name) for name in node])
    numbers = array("sequence numbers", sequence, (len(names),))
    when = None if sent is None else array("times of sending", sent, (len(names),))
    return {
        str(name): fates_of_sequence(numbers[names == name], None if when is None else when[names == name])
        for name in dict.fromkeys(names.tolist())
    }


def fates_by_hop(arrived: "Mapping[str, Float[ArrayLike, ' packets']]") -> dict[str, Fates]:
    """Return {hop: fates (packets,)} of the packets of a route, by which of them arrived behind each of its hops.

    Fates are 1 (lost), 0 (arrived) or NaN (unknown); laws of losses are fitted to them. A packet that was lost says
    nothing of the hops that it did not reach: its fate is NaN there.

    Args:
        arrived: {hop: (packets,)} in the order of the route, true or 1 where the packet arrived behind this hop.

    Raises:
        ValueError: no hops, other values, a packet that arrived behind a hop but not before it.
    """
    if not table("arrivals by hop", arrived, "arrays"):
        raise fail("arrivals by hop", "at least one hop", "none")
    by_hop: dict[str, Fates] = {}
    reached: np.ndarray | None = None  # 1 of packets that passed the hop before; None at the first hop, all of them
    for name, value in arrived.items():
        # Which packets arrived behind this hop. None can without having arrived behind the hop before.
        passed = array(f"arrivals behind {name!r}", value, (None if reached is None else len(reached),))
        if np.any((passed != 0) & (passed != 1)):
            raise fail(f"arrivals behind {name!r}", "0 and 1, or truth values", "other numbers")
        reached = np.ones(len(passed)) if reached is None else reached
        if np.any(passed > reached):
            packet = int(np.argmax(passed > reached))
            raise fail(
                f"arrivals behind {name!r}", "packets that passed the hop before", f"packet {packet}, which did not"
            )
        # A packet has a fate at a hop only if it reached the hop.
        by_hop[name] = [np.where(reached == 1, 1.0 - passed, np.nan)]
        reached = passed
    return by_hop


def fates_of_measurements(measurements: "Mapping[str, Float[ArrayLike, 'steps *received']]") -> dict[str, Fates]:
    """Return the fates of each node's packets in a recording, one packet a step, where NaN is a loss.

    If all components of a node arrive together, they are one packet under the node's name. Otherwise each component is
    a packet of its own, NODE.0, NODE.1, ... A component that never arrived counts as not sent.

    Args:
        measurements: {node: (steps, received)} or (steps,), NaN where a component did not arrive.

    Raises:
        ValueError: no table of numbers.
    """
    fates: dict[str, Fates] = {}
    for node, value in table("measurements", measurements, "arrays").items():
        name = f"measurements of {node!r}"
        values = array(name, value, (None,) if rank(name, value) == 1 else (None, None), missing=True)
        matrix = values[:, None] if values.ndim == 1 else values  # (steps, received)
        lost = np.isnan(array(name, matrix, (None, None), missing=True))
        if np.all(lost == lost[:, :1]):
            fates[node] = [lost[:, 0].astype(float)]
        else:
            fates |= {f"{node}.{i}": [column.astype(float)] for i, column in enumerate(lost.T) if not np.all(column)}
    return fates


def check_fates(value: object) -> Fates:
    """Return fates, checked, as a list of stretches (packets,) without empty ones.

    Fates of packets are the data from which laws of losses are fitted. A stretch (run of successive packets) may have
    been cut where packets arrived (`BetweenArrivals`): its ends say nothing of losses, are not counted as trials, and
    are marked by the value CHOSEN.

    Args:
        value: one stretch of 0 (arrived), 1 (lost) and NaN (unknown), or a sequence of several.

    Raises:
        ValueError: anything but 0, 1 and NaN, or nothing that is known.
    """
    # What this function returned before is not checked again.
    if isinstance(value, CheckedFates):
        return value
    stretches = _list_stretches(value)
    # Check the values of each stretch.
    parts = [array("fates", cast(ArrayLike, stretch), (None,), missing=True) for stretch in stretches]
    for fate in parts:
        if np.any((fate != 0) & (fate != 1) & ~np.isnan(fate)):
            raise fail(
                "fates", "0 for a packet that arrived, 1 for a lost one, NaN for an unknown one", "other numbers"
            )
    # Mark chosen ends, and leave out empty stretches.
    chosen = [getattr(stretch, "chosen", False) for stretch in stretches]
    fates = CheckedFates(
        _mark_chosen_ends(fate) if is_chosen else fate
        for fate, is_chosen in zip(parts, chosen, strict=True)
        if len(fate)
    )
    if not any(np.any(find_trials(fate)) for fate in fates):
        raise fail("fates", "at least one packet of which the fate is known and that is no end of its stretch", "none")
    return fates


def _list_stretches(value: object) -> list[Any]:
    """Return the stretches of `value`: its members if all of them have one axis, else `value` as the only one."""
    is_sequence = isinstance(value, Sequence) or rank("fates", value) > 0
    members: list[Any] = list(cast(Sequence[Any], value)) if is_sequence else [value]
    are_stretches = len(members) > 0 and all(rank("fates", member) == 1 for member in members)
    return members if are_stretches else [value]


def _mark_chosen_ends(fate: np.ndarray) -> Float[np.ndarray, " packets"]:
    """Return the fates (packets,) with the first and the last replaced by CHOSEN."""
    ends = np.zeros(len(fate), dtype=bool)
    ends[[0, -1]] = True
    return np.where(ends, CHOSEN, fate)
