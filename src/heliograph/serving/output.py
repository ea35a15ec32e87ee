"""Outputs of a service: estimates, provisional and final, and refusals."""

import json
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, Field, TypeAdapter

from heliograph.model.estimate import Claim

Kind = Literal["provisional", "final", "refused", "message"]


class Output(NamedTuple):
    """A line of JSON about a plant, to be published.

    Args:
        number: running count of the outputs that are published exactly once; None for others.
        plant: name of the plant.
        kind: "provisional", "final" or "refused"; "message" to the service of another node.
        body: the line of JSON, without newline.
        to: the node to whose service a message goes.
    """

    number: int | None
    plant: str
    kind: Kind
    body: bytes
    to: str = ""


class WeighedOutputs(BaseModel):
    """Innovations and weights of a filter that weighs, by received number; null where none arrived.

    Args:
        value: innovations, in the units of the numbers.
        variance: their variances by the filter's model.
        weight: weights in the update, from 0 (left out) to 1 (in full).
    """

    value: list[float | None]
    variance: list[float | None]
    weight: list[float | None]


class FilterOutput(BaseModel):
    """Estimate of one filter; null stands for a number that is not finite.

    Args:
        mean: estimated state, n numbers.
        covariance: n rows of n numbers; null if the filter claims no covariance.
        claim: what the covariance is: exact, upper, nominal or none.
        nis: normalised innovation squared of the received measurement, of a fusion of estimates that of what its nodes
            received; null if nothing was received, or where a fusion has no such test.
        received: number of received components, the expected value of `nis`.
        implausible: reason why this filter alone did not use the measurement; empty if it did.
        outputs: of a filter that weighs, what it made of each received number; left out of all others.
        modes: of a filter that weighs modes, the probability of each; left out of all others.
    """

    mean: list[float | None]
    covariance: list[list[float | None]] | None = Field(description="Null of a filter that claims none.")
    claim: Claim = Field(description="What the covariance is: exact, upper, nominal; none also where it is no number.")
    nis: float | None = Field(
        None, description="Normalised innovation squared of what was received; null if nothing was."
    )
    received: int = Field(0, description="How many numbers were received: what nis should be on average.")
    implausible: str = Field("", description="Why this filter alone did not use what was received, where it did not.")
    outputs: WeighedOutputs | None = Field(None, description="Of a filter that weighs: what it made of each number.")
    modes: list[float | None] | None = Field(None, description="Of a filter that weighs modes: their probabilities.")


class SenderOutput(BaseModel):
    """Status of a sender that decides when to send, or of a node with a timeout, by the time of the newest arrival.

    Args:
        last: step of its newest value, or its time where time is continuous; null before the first.
        silent: steps since then that are final, at which it sent nothing or what it sent was lost, or the time.
        provisional: later ones at which nothing came yet.
        missed: heartbeats that were due in the silent steps and did not come.
        chance: probability that the link lost all of these.
        timeout: for how long nothing need come; null for any time.
        refused: how many of its readings its node refused, by reason, and messages for their flag or counter.
        unit: of the times, "steps" or that of the plant; empty where that has none.
        dead: true where that chance is below 1 in 1,000, or where nothing came for longer than the timeout: the value
            is unknown then, not constant.
        reason: why it is dead, in words; empty if it is not.
    """

    last: float | None
    silent: float
    provisional: float
    missed: int
    chance: float
    timeout: float | None = None
    refused: dict[str, int] = {}
    unit: str = "steps"
    dead: bool
    reason: str = ""


class OutputAhead(BaseModel):
    """Forecast of what a sensor would measure at one horizon.

    Args:
        mean: expected value.
        deviation: claimed standard deviation; null where nothing is claimed.
    """

    mean: float | None
    deviation: float | None


class Passing(BaseModel):
    """Probabilities that a number crosses a threshold, from drawn paths.

    Args:
        then: that the number is beyond the level at the horizon.
        by: that it has been so at the horizon or any step before; where time is continuous, at an earlier horizon.
        by_error: standard error of the drawing of `by`.
    """

    then: float
    by: float
    by_error: float


class FilterAhead(BaseModel):
    """Forecast of one filter at one horizon; null stands for a number that is not finite.

    Args:
        mean: state, n numbers.
        covariance: n rows of n numbers; null if the filter claims no covariance.
        claim: what the covariance is: exact, upper, nominal or none.
        outputs: what the filter's sensor would measure, by name; left out where it is not known.
        thresholds: by level, as level>30, the probabilities that it is passed; left out unless asked for.
    """

    mean: list[float | None]
    covariance: list[list[float | None]] | None
    claim: Claim
    outputs: dict[str, OutputAhead] = {}
    thresholds: dict[str, Passing] = {}


class Horizon(BaseModel):
    """Forecasts of a plant's filters at one horizon, with inputs held.

    Args:
        time: of the horizon: steps, seconds or an ISO 8601 date.
        ahead: how far it is, in seconds, or steps of messages without dates.
        estimates: of each filter, by node and filter.
    """

    time: float | str
    ahead: float
    estimates: dict[str, dict[str, FilterAhead]]


class Estimates(BaseModel):
    """Estimates of a plant's filters after the row at `time`, by node and filter; fused ones under "fused".

    Args:
        id: running count of the final outputs of a store; null for provisional ones. A repeated output has the same.
        kind: "provisional" estimates may still change by late measurements, "final" ones do not.
        plant: name of the plant.
        time: time of the row: steps, seconds or an ISO 8601 date.
        estimates: the filters' estimates by node and filter.
        forecast: of provisional ones, what is forecast at each horizon; left out unless asked for.
        senders: of provisional ones, senders of which silence says something, by node; left out where there are none.
    """

    id: int | None = Field(
        None, description="Of final ones: counts what is published once; published again it is the same."
    )
    kind: Literal["provisional", "final"] = Field(description="Provisional ones may change by what comes late.")
    plant: str
    time: float | str
    estimates: dict[str, dict[str, FilterOutput]]
    forecast: list[Horizon] = Field([], description="Of provisional ones: what is ahead, where it is asked for.")
    senders: dict[str, SenderOutput] = Field({}, description="Of provisional ones: what silence says, by node.")


class Refused(BaseModel):
    """Refusal of a message, with the reason.

    Args:
        id: running count, shared with the final estimates.
        kind: "refused".
        plant: name of the plant; null, as the next three, if the message could not be read.
        node: name of the node.
        sequence: the node's count.
        time: moment of the measurement.
        reason: one of "duplicate", "conflict", "late", "future", "implausible", "malformed", "damaged".
        detail: the reason in words.
    """

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
    """Return the JSON schema of an output line."""
    return TypeAdapter(AnyOutput).json_schema()


def parse_output(line: str) -> Output:
    """Return the output that a line of the journal, its body of JSON, stands for."""
    parts = json.loads(line)
    return Output(parts["id"], parts["plant"] or "", parts["kind"], line.encode())
