"""A service whose batches are observed, and what its observer needs of it."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from threading import Lock
from typing import Protocol

from heliograph.serving.count_totals import LinkTotals
from heliograph.serving.message import Payload
from heliograph.serving.output import Output
from heliograph.serving.service_loop import BatchService


class WatchedPlant(Protocol):
    """A plant as the page needs it."""

    @property
    def links(self) -> Mapping[str, LinkTotals]:
        """Return the counts of the plant's links, by node."""


class BatchTimes(Protocol):
    """How long the last batch took, and how old its messages were."""

    @property
    def took(self) -> float:
        """Return the seconds of the whole batch."""

    @property
    def committed(self) -> float:
        """Return the seconds of the commit."""

    @property
    def lag(self) -> float:
        """Return the age of the oldest message in seconds, where it is dated; else the seconds of the batch."""


class WatchableService(BatchService, Protocol):
    """A service as the page needs it."""

    @property
    def plants(self) -> Mapping[str, WatchedPlant]:
        """Return the plants in memory, by name."""

    @property
    def malformed(self) -> int:
        """Return the number of messages that could not be read."""

    @property
    def last(self) -> BatchTimes:
        """Return the statistics of the last batch."""

    def dead_senders(self) -> Mapping[str, int]:
        """Return how many plants have a dead sender, by node with a trigger."""

    def remarks(self) -> Mapping[tuple[str, str], int]:
        """Return how often each filter that may say so had a state changed as users should know, by node and name."""


class ServiceObserver(Protocol):
    """The observer of a service."""

    lock: Lock

    def taking_batch(self) -> AbstractContextManager[None]:
        """Return what holds the lock while a batch is taken."""

    def note(self, outputs: Sequence[Output], last: BatchTimes | None) -> None:
        """Record the outputs and statistics of a batch."""


class ObservedService:
    """A service whose batches are observed; the loop uses it like the service."""

    def __init__(self, service: WatchableService, watch: ServiceObserver):
        """Hold the service, and the watch that is told of each of its batches."""
        self.service, self.watch = service, watch

    def unpublished(self) -> list[Output]:
        """Return the service's unpublished outputs."""
        return self.service.unpublished()

    def take(self, payloads: Sequence[Payload]) -> list[Output]:
        """Let the service take a batch, and record its outputs; an empty batch is not in the batches' statistics."""
        with self.watch.taking_batch():
            outputs = self.service.take(payloads)
            self.watch.note(outputs, self.service.last if payloads else None)
        return outputs

    def published(self, outputs: Sequence[Output]) -> None:
        """Tell the service that outputs were published."""
        self.service.published(outputs)

    def finish(self, ended: bool) -> list[Output]:
        """Let the service commit everything, and return its last outputs; the page waits meanwhile."""
        with self.watch.lock:
            return self.service.finish(ended)
