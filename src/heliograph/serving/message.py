"""What comes in: one event of one plant, as JSON; its schema is the documentation that a sender needs."""

from datetime import datetime
from shlex import quote
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, GetPydanticSchema, TypeAdapter, ValidationError, WithJsonSchema
from pydantic_core.core_schema import no_info_after_validator_function, str_schema

from heliograph.numerics.check import fail, instance, shown
from heliograph.numerics.dates import instant

Name = Annotated[str, Field(max_length=200, pattern=r"^[^\x00]*$")]  # PostgreSQL keeps no NUL
# Text that is no date is refused: "0.1" is no number of seconds, nor a moment of 1970.
Date = Annotated[
    datetime,
    GetPydanticSchema(lambda _, __: no_info_after_validator_function(instant, str_schema())),
    WithJsonSchema({"type": "string", "format": "date-time"}),
]
Moment = float | Date
EXPECTED = {
    "plant": "a name of at most 200 characters, without NUL",
    "node": "a name of at most 200 characters, without NUL",
    "sequence": "a whole number from 0 to 2^63 - 1",
    "time": "a finite number, not in quotes, or an ISO 8601 date with a zone",
    "arrival": "a finite number, not in quotes, or an ISO 8601 date with a zone",
    "values": "a list of finite numbers, not in quotes; null for what did not arrive",
    "inputs": "a list of finite numbers, not in quotes; null for what stays as it was",
}
LONGEST = 1 << 20  # bytes of a message; what is longer is refused unread


class Message(BaseModel):
    """What a node of a plant measured, and the plant's inputs at that time, which may be left out.

    A node, its number there and a time name an event: sent again it is a duplicate and changes nothing.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    plant: Name = Field("", description="Which of the plants that are of this network; one needs no name.")
    node: Name = Field(description='A node of the network, or "inputs": then the values are the plant\'s inputs.')
    sequence: int = Field(ge=0, lt=2**63, description="The node's own count; gaps in it are what was lost.")
    time: Moment = Field(description="When it was measured: steps, seconds, or an ISO 8601 date with a zone.")
    values: list[float | None] = Field(default=[], description="Values received; null did not arrive.")
    inputs: list[float | None] | None = Field(None, description="The plant's inputs without dt; null stays as it was.")
    arrival: Moment | None = Field(None, description="Time of arrival; at once if left out.")


_READER = TypeAdapter(Message)


def read_message(payload: bytes) -> Message:
    """The message in a line of JSON.

    Raises:
        ValueError: what is no message; one line that names the part.
    """
    instance("message", payload, bytes, "bytes")
    if len(payload) > LONGEST:
        raise fail("message", f"at most {LONGEST} bytes", len(payload))
    try:
        return _READER.validate_json(payload)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        part = str(first["loc"][0]) if first["loc"] else ""
        if part not in EXPECTED:  # no JSON object, or one with a field more
            fields = f"a JSON object with no fields but {', '.join(EXPECTED)}"
            raise fail("message", fields, shown(part) if part else f"{shown(payload)} ({first['msg']})") from None
        came = "no such field" if first["type"] == "missing" else shown(first["input"])
        raise fail(f"message, {part}", EXPECTED[part], came) from None


def seconds(moment: float | datetime, origin: datetime | None, plant: str) -> float:
    """A time as a number: of dates the seconds since `origin`, exact to the microsecond before they are one.

    Raises:
        ValueError: a date where times are numbers, or a number where they are dates.
    """
    mend = f"if its first message was wrong, serve --anew {quote(plant)} begins it anew"
    if isinstance(moment, datetime):
        if origin is None:
            raise fail("message, time", "a number, as this plant's times are", f"{moment.isoformat()}; {mend}")
        return (moment - origin).total_seconds()
    if origin is not None:
        raise fail("message, time", "a date, as this plant's times are", f"{moment}; {mend}")
    return moment


def schema() -> dict[str, object]:
    """JSON schema of a message."""
    return Message.model_json_schema()
