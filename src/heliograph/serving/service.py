"""The service: batches of messages in, what is to be told out; all that it knows is committed in between."""

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, time, timedelta
from time import perf_counter
from typing import Any, NamedTuple

from heliograph.live.event import INPUTS, Verdict
from heliograph.numerics.check import InputError, shown
from heliograph.serving.fleet import Fleet, Options, Settled
from heliograph.serving.message import Message, read_message, seconds
from heliograph.serving.output import Output
from heliograph.serving.plant import Plant
from heliograph.serving.telling import Teller, line
from heliograph.simulation.network import Network

WHY: dict[Verdict, str] = {
    "duplicate": "held already",
    "conflict": "held already with other values, which stay",
    "late": "before what is final",
    "future": "later than it can be: a clock is wrong",
}


class Taken(NamedTuple):
    """What the last batch was: numbers of messages and outputs, and the seconds that it took in all and to commit."""

    messages: int
    outputs: int
    took: float
    committed: float


class Service:
    """A network's filters, for any number of plants, fed with messages in whatever order they come.

    It knows no transport: `take` uses a batch and gives what is to be told of it, after the commit. One call at a time.
    """

    def __init__(self, network: Network, options: Options):
        self.fleet = Fleet(network, options)
        self.plants = dict[str, Plant]()
        self.malformed, self.last = 0, Taken(0, 0, 0.0, 0.0)
        self._teller = Teller(self.fleet.lanes)
        self._number = 0  # of what is told once
        self._origin: datetime | None = None  # that times are counted from where they are dates
        self._begun = False

    def take(self, payloads: Sequence[bytes]) -> list[Output]:
        """Use messages, each a JSON object, and commit; what is to be told of it.

        Nothing in a message stops the service: what cannot be used is counted and told, with the reason.
        """
        begun = perf_counter()
        touched = dict[str, Plant]()
        outputs = []
        used = set[str]()
        for payload in payloads:
            try:
                message = read_message(payload)
                plant, verdict = self._use(message)
            except InputError as error:
                self.malformed += 1
                outputs.append(self._refused(None, {}, "malformed", f"{error}: {shown(payload)}"))
                continue
            touched[plant.name] = plant
            if verdict == "used":
                used.add(plant.name)
            else:
                outputs.append(self._refuse(message, verdict))
        settled = self.fleet.settle(touched.values())
        outputs += self._finals(settled) + self._provisional(each for each in settled if each.plant.name in used)
        self.fleet.forget(settled)
        self.last = Taken(len(payloads), len(outputs), perf_counter() - begun, 0.0)
        return outputs

    def unpublished(self) -> list[Output]:
        """What was committed before a restart and may not have been told."""
        return []

    def published(self, outputs: Sequence[Output]) -> None:
        """These were told: remembered with the next commit."""

    def finish(self, ended: bool) -> list[Output]:
        """Commit all. Where nothing is kept and there will be no more messages, all rows become final."""
        if not ended:
            return []
        settled = self.fleet.settle(plant.end() for plant in self.plants.values())
        outputs = self._finals(settled)
        self.fleet.forget(settled)
        return outputs

    def _use(self, message: Message) -> tuple[Plant, Verdict]:
        """Give a message to its plant."""
        at, came = self._times(message)
        plant = self.plants.get(message.plant)
        now = at if plant is None else plant.now
        arrival = max(now, at) if came is None else came
        event = self.fleet.known(message.node, message.sequence, at, message.values, arrival)
        given = message.inputs
        inputs = None if given is None else self.fleet.known(INPUTS, message.sequence, at, given, arrival)
        if plant is None:
            plant = self.plants[message.plant] = self.fleet.begin(message.plant, at)
        if inputs is not None:
            self.fleet.take(plant, inputs)
        verdict = self.fleet.take(plant, event)
        plant.link(message.node).count(verdict, message.sequence)
        return plant, verdict

    def _times(self, message: Message) -> tuple[float, float | None]:
        """When it was measured and when it came, as numbers."""
        if not self._begun:
            if isinstance(message.time, datetime):
                self._origin = datetime.combine(message.time.astimezone(UTC).date(), time(), UTC)
            self._begun = True
        at = seconds(message.time, self._origin)
        return at, None if message.arrival is None else seconds(message.arrival, self._origin)

    def _finals(self, settled: Iterable[Settled]) -> list[Output]:
        """What is told of rows in which something was heard."""
        rows = [(each.plant.name, row) for each in settled for row in each.final if row.hears()]
        told = self.fleet.told([row.slot for _, row in rows])
        return [self._estimates("final", plant, row.key[0], numbers)
                for (plant, row), numbers in zip(rows, told, strict=True)]  # fmt: skip

    def _provisional(self, settled: Iterable[Settled]) -> list[Output]:
        rows = [(each.plant.name, each.newest) for each in settled]
        told = self.fleet.told([row.slot for _, row in rows])
        bodies = [self._teller.estimates(None, "provisional", plant, self._moment(row.key[0]), numbers)
                  for (plant, row), numbers in zip(rows, told, strict=True)]  # fmt: skip
        return [Output(None, plant, "provisional", body) for (plant, _), body in zip(rows, bodies, strict=True)]

    def _estimates(self, kind: str, plant: str, at: float, told: list[float]) -> Output:
        self._number += 1
        body = self._teller.estimates(self._number, kind, plant, self._moment(at), told)
        return Output(self._number, plant, "final", body)

    def _refuse(self, message: Message, why: Verdict) -> Output:
        moment = message.time.isoformat() if isinstance(message.time, datetime) else message.time
        parts = {"node": message.node, "sequence": message.sequence, "time": moment}
        return self._refused(message.plant, parts, why, WHY[why])

    def _refused(self, plant: str | None, parts: dict[str, Any], why: str, detail: str) -> Output:
        self._number += 1
        found = {"id": self._number, "kind": "refused", "plant": plant, "node": None, "sequence": None, "time": None}
        return Output(self._number, plant or "", "refused", line(found | parts | {"reason": why, "detail": detail}))

    def _moment(self, at: float) -> float | str:
        """A time as it was told."""
        return at if self._origin is None else (self._origin + timedelta(seconds=at)).isoformat()
