"""A reader for logs of a TSCH testbed: packets as the root of a time-slotted radio network received them.

A row is 38 bytes as a list, a tab, and the host's time, which drifts and is not used. Numbers have their lowest byte
first: [1:6] the slot in which the packet was received, [6:11] that in which it was sent, [11:13] its sequence number,
[14:38] up to six hops of four bytes (address, tries, channel, signal strength; address 0: none). The first hop is the
node that sent it.

Source: Vilgelm, Gürsu, Zoppi, Kellerer, Time slotted channel hopping for smart metering (2016).
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from heliograph.numerics.check import fail
from heliograph_studies.late_data.packets import Packets

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
