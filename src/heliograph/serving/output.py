"""What goes out: estimates, provisional and final, and what was refused."""

from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, Field, TypeAdapter

from heliograph.model.estimate import Claim

Kind = Literal["provisional", "final", "refused"]


class Output(NamedTuple):
    """A line of JSON about a plant. `number` counts what is told exactly once; provisional estimates have none."""

    number: int | None
    plant: str
    kind: Kind
    body: bytes


class FilterOutput(BaseModel):
    """What one filter knows; null where a number is none."""

    mean: list[float | None]
    covariance: list[list[float | None]] | None = Field(description="Null of a filter that claims none.")
    claim: Claim = Field(description="What the covariance is: exact, upper, nominal; none also where it is no number.")
    nis: float | None = Field(
        None, description="Normalised innovation squared of what was received; null if nothing was."
    )
    received: int = Field(0, description="How many numbers were received: what nis should be on average.")
    implausible: str = Field("", description="Why this filter alone did not use what was received, where it did not.")


class Estimates(BaseModel):
    """The filters of a plant after the row at `time`, by node and filter; those of several nodes under "fused"."""

    id: int | None = Field(
        None, description="Of final ones: counts what is published once; published again it is the same."
    )
    kind: Literal["provisional", "final"] = Field(description="Provisional ones may change by what comes late.")
    plant: str
    time: float | str
    estimates: dict[str, dict[str, FilterOutput]]


class Refused(BaseModel):
    """What was refused, and why."""

    id: int
    kind: Literal["refused"]
    plant: str | None
    node: str | None
    sequence: int | None
    time: float | str | None
    reason: Literal["duplicate", "conflict", "late", "future", "implausible", "malformed", "damaged"]
    detail: str


AnyOutput = Annotated[Estimates | Refused, Field(discriminator="kind")]


def schema() -> dict[str, object]:
    """JSON schema of a line that is told."""
    return TypeAdapter(AnyOutput).json_schema()
