"""Reports of a service on messages that it refused, as entries for the store."""

from datetime import datetime

from heliograph.live.event import Verdict
from heliograph.serving.estimate_writer import encode_line
from heliograph.serving.message import Read, UnreadMessage
from heliograph.serving.storage.store_protocol import Entry

WHY: dict[Verdict, str] = {
    "duplicate": "held already",
    "conflict": "held already with other values, which stay",
    "late": "before what is final",
    "future": "later than it can be: a clock is wrong",
    "implausible": "no filter could use it",
}


def make_refusal_of_message(message: Read, why: str, detail: str) -> Entry:
    """Return the refusal of a message, to be published, with its node, sequence and time if these were read.

    Args:
        message: the message, as far as it was read.
        why: the kind of reason: a verdict, "malformed" or "damaged".
        detail: the reason in words.
    """
    if isinstance(message, str):  # nothing was read
        return make_refusal_entry(None, {}, why, detail)
    known = message.read if isinstance(message, UnreadMessage) else message
    moment = known.time.isoformat() if isinstance(known.time, datetime) else known.time
    identity = {"node": known.node, "sequence": known.sequence, "time": moment}
    return make_refusal_entry(known.plant, identity, why, detail)


def make_refusal_entry(plant: str | None, parts: dict[str, object], why: str, detail: str) -> Entry:
    """Return the refusal of a message as an entry for the store: its plant, its kind and a line of JSON.

    Args:
        plant: name of the message's plant; None if it is not known.
        parts: "node", "sequence" and "time" of the message, those that are known; the others become null.
        why: the kind of reason, published as "reason".
        detail: the reason in words.
    """
    results = {"kind": "refused", "plant": plant, "node": None, "sequence": None, "time": None}
    return Entry(plant or "", "refused", encode_line(results | parts | {"reason": why, "detail": detail}))
