"""Messages that a service receives: one event of one plant, as JSON; the schema is documentation for senders."""

import json
import re
from collections.abc import Sequence
from datetime import datetime
from shlex import quote
from typing import Annotated, NamedTuple, TypeAlias

import msgspec
from pydantic import BaseModel, ConfigDict, Field, GetPydanticSchema, TypeAdapter, ValidationError, WithJsonSchema
from pydantic_core.core_schema import no_info_after_validator_function, str_schema
from typing_extensions import TypeAliasType

from heliograph.model.checks.refusal_reasons import Reason
from heliograph.numerics.check import InputError, fail, instance, show_value
from heliograph.numerics.times.dates import parse_instant

Name = TypeAliasType("Name", Annotated[str, Field(max_length=200, pattern=r"^[^\x00]*$")])  # PostgreSQL keeps no NUL
# Text that is no date is refused: "0.1" is no number of seconds, nor a moment of 1970.
Date = Annotated[
    datetime,
    GetPydanticSchema(lambda _, __: no_info_after_validator_function(parse_instant, str_schema())),
    WithJsonSchema({"type": "string", "format": "date-time"}),
]
Moment = TypeAliasType("Moment", float | Date)
Count = TypeAliasType("Count", Annotated[int, Field(ge=0, lt=2**63)])
EXPECTED = {
    "plant": "a name of at most 200 characters, without NUL",
    "node": "a name of at most 200 characters, without NUL",
    "sequence": "a whole number from 0 to 2^63 - 1",
    "time": "a finite number, not in quotes, or an ISO 8601 date with a zone",
    "arrival": "a finite number, not in quotes, or an ISO 8601 date with a zone",
    "values": "a list of finite numbers, not in quotes; null for what did not arrive",
    "inputs": "a list of finite numbers, not in quotes; null for what stays as it was",
}
NAMED = "plant", "node", "sequence", "time"  # what names a message
LONGEST = 1 << 20  # bytes of a message; what is longer is refused unread


class Message(BaseModel):
    """Measurements of a node of a plant at one time, and the plant's inputs at that time, which may be left out.

    A node, its count and a time identify an event: sent again it is a duplicate and changes nothing.

    Args:
        plant: name of the plant; a single plant needs none.
        node: name of a node of the network, or "inputs", in which case `values` are the plant's inputs.
        sequence: the node's running count of events, from 0; gaps are lost messages.
        time: moment of the measurement: steps, seconds, or an ISO 8601 date with a time zone.
        values: received values, one for each component; null did not arrive.
        inputs: the plant's inputs without dt; null keeps its value.
        arrival: moment of arrival; by default at once.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    plant: Name = Field("", description="Which of the plants that are of this network; one needs no name.")
    node: Name = Field(description='A node of the network, or "inputs": then the values are the plant\'s inputs.')
    sequence: Count = Field(description="The node's own count; gaps in it are what was lost.")
    time: Moment = Field(description="When it was measured: steps, seconds, or an ISO 8601 date with a zone.")
    values: list[float | None] = Field(default=[], description="Values received; null did not arrive.")
    inputs: list[float | None] | None = Field(None, description="The plant's inputs without dt; null stays as it was.")
    arrival: Moment | None = Field(None, description="Time of arrival; at once if left out.")


ShortName: TypeAlias = Annotated[str, msgspec.Meta(max_length=200)]


class NumberedMessage(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """Message as `Message` has it, decoded seven times as fast; its times are numbers."""

    node: ShortName
    sequence: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    time: float
    plant: ShortName = ""
    values: list[float | None] = []
    inputs: list[float | None] | None = None
    arrival: float | None = None


class UnreadMessage(NamedTuple):
    """A message that cannot be used although its node, count and time were read, and why it cannot.

    Args:
        read: what was read of it.
        why: why it cannot be used, in words.
        reason: what it is refused for, of its flag and its counter; None of any other message.
        counted: whether its sequence is its node's running count.
    """

    read: "Message | NumberedMessage"
    why: str
    reason: Reason | None = None
    counted: bool = True


AnyMessage: TypeAlias = Message | NumberedMessage
Read: TypeAlias = AnyMessage | UnreadMessage | str  # a message, as far as it could be read; only why it could not
Payload: TypeAlias = bytes | Read  # a line of JSON; what was read already
_READER, _FAST = TypeAdapter(Message), msgspec.json.Decoder(NumberedMessage)


def read_messages(payloads: Sequence[Payload]) -> list[Read]:
    """Return the messages of payloads; of what cannot be read the reason, with node, count and time if it has these.

    A fast decoder is tried first; what it refuses is read again by one that explains. It reads only times that are
    numbers, so that it is not tried if the time of the first payload is a date.

    A result is the message, an `UnreadMessage` (node, count and time of one that cannot be used, with the reason), or,
    if not even these can be read, the reason as a text. `_read_or_explain` is the decoder that explains.

    Args:
        payloads: lines of JSON, or what was read of them already.
    """
    results = list[Read]()
    quick = not payloads or not isinstance(payloads[0], bytes) or re.search(rb'"time":\s*"', payloads[0]) is None
    for payload in payloads:
        if not isinstance(payload, bytes):
            results.append(payload)
            continue
        try:
            if not quick or rb"\u0000" in payload or len(payload) > LONGEST:  # the fast one does not refuse NUL
                raise msgspec.DecodeError
            read = _FAST.decode(payload)
            _refuse_doubled_fields(payload, read)
            results.append(read)
        except (msgspec.DecodeError, UnicodeDecodeError, InputError):
            results.append(_read_or_explain(payload))
    return results


def _read_or_explain(payload: bytes) -> Message | UnreadMessage | str:
    """Return the message in a payload, or why it cannot be read.

    If its plant, node, count and time (NAMED) can be read all the same, they are returned with the reason, so that the
    message does not count as lost. Of a payload too long only the first LONGEST bytes are looked at.
    """
    try:
        return read_message(payload)
    except InputError as error:
        why = str(error)
    try:
        fields = json.loads(payload[:LONGEST], object_pairs_hook=tuple)  # an object as pairs (name, value)
        names = [(name, value) for name, value in fields if name in NAMED] if isinstance(fields, tuple) else []
        if len(dict(names)) < len(names):  # a field twice: nobody knows which of the two names it
            return why
        named = Message.model_validate_json(json.dumps(dict(names)))
    except (ValueError, TypeError, RecursionError):  # no JSON object, or one that names nothing
        return why
    return UnreadMessage(named, why)


def read_message(payload: bytes) -> Message:
    """Return the message in a line of JSON.

    Args:
        payload: the line, of at most LONGEST bytes.

    Raises:
        ValueError: no valid message; one line that names the part.
    """
    instance("message", payload, bytes, "bytes")
    if len(payload) > LONGEST:
        raise fail("message", f"at most {LONGEST} bytes", len(payload))
    try:
        read = _READER.validate_json(payload)
        _refuse_doubled_fields(payload, read)
        return read
    except ValidationError as error:
        # Only the first fault is named: by its field, what is expected there (EXPECTED), and what came.
        first = error.errors(include_url=False, include_context=False)[0]
        field = str(first["loc"][0]) if first["loc"] else ""
        if field not in EXPECTED:  # no JSON object, or one with a field more
            fields = f"a JSON object with no fields but {', '.join(EXPECTED)}"
            raise fail("message", fields, show_value(field) if field else _describe_payload(payload)) from None
        came = "no such field" if first["type"] == "missing" else show_value(first["input"])
        raise fail(f"message, {field}", EXPECTED[field], came) from None


def _refuse_doubled_fields(payload: bytes, read: AnyMessage) -> None:
    """Raise ValueError if a line has a field twice; decoders would use the last one.

    Each field's name and each text has two quotes. If a line has no more quotes than what was read, no field is there
    twice. Any other line is decoded again, which takes longer.
    """
    # The fields node, sequence and time are always there. Texts are the node's name and others that are there.
    fields = 3 + (read.plant != "") + (read.values != []) + (read.inputs is not None) + (read.arrival is not None)
    texts = 1 + (read.plant != "") + isinstance(read.time, datetime) + isinstance(read.arrival, datetime)
    if payload.count(b'"') == 2 * (fields + texts):
        return
    names = [name for name, _ in json.loads(payload, object_pairs_hook=tuple)]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise fail("message", "distinct fields", f"{twice!r} more than once")


def _describe_payload(payload: bytes) -> str:
    """Return in words what a payload is, if it is not a JSON object."""
    try:
        return f"{show_value(json.loads(payload))}, which is no object"
    except RecursionError:
        return "brackets nested too deeply"
    except ValueError as error:
        where = f" from byte {error.pos + 1} on" if isinstance(error, json.JSONDecodeError) else ""
        looks_like_row = b"," in payload and b"{" not in payload
        hint = "; `heliograph replay` sends the rows of a table as messages" if looks_like_row else ""
        return f"{show_value(payload)}, which is no JSON{where}{hint}"


def convert_time_to_seconds(moment: float | datetime, origin: datetime | None, plant: str) -> float:
    """Return a time as a number; a date becomes seconds since `origin`, exact to the microsecond before rounding.

    If a plant has an origin, all its times must be dates, else all must be numbers; ValueError otherwise.
    """
    remedy = f"if its first message was wrong, serve --anew {quote(plant)} begins it anew"
    if isinstance(moment, datetime):
        if origin is None:
            raise fail("message, time", "a number, as this plant's times are", f"{moment.isoformat()}; {remedy}")
        return (moment - origin).total_seconds()
    if origin is not None:
        raise fail("message, time", "a date, as this plant's times are", f"{moment}; {remedy}")
    return moment


def schema() -> dict[str, object]:
    """Return the JSON schema of a message."""
    return Message.model_json_schema()
