"""A service whose store may be away: it waits for a database as for a broker, and then goes on."""

import asyncio
import random
from collections.abc import Callable, Sequence
from time import sleep
from typing import TypeVar

from heliograph.serving.brokers.transport import FIRST, LOG, LONGEST
from heliograph.serving.message import Payload
from heliograph.serving.output import Output
from heliograph.serving.service_loop import BatchService
from heliograph.serving.storage.store_protocol import AwayError

T = TypeVar("T")
LOOK = 0.1  # seconds between looks at whether to stop


def retry_while_away(act: Callable[[], T], stop: asyncio.Event) -> T:
    """Call `act` until the store that it uses is not away, with waits that double, and return what it returns.

    Raises:
        AwayError: the store is away, and `stop` is set.
    """
    wait, was_away = FIRST, False  # seconds of the next wait
    while True:
        try:
            done = act()
        except AwayError as error:
            if stop.is_set():
                raise
            left = wait * random.uniform(0.5, 1.0)  # seconds; drawn, so that processes do not all come at once
            LOG.warning("%s; trying again in %.1f s", error, left)
            wait, was_away = min(2 * wait, LONGEST), True
            while left > 0 and not stop.is_set():
                sleep(LOOK)
                left -= LOOK
        else:
            if was_away:
                LOG.info("the store is there again")
            return done


class WaitingService:
    """A service that waits for its store: nothing is acknowledged before it is committed.

    After a failed commit it is not known whether it was one: what the store has and nobody was told is published first.
    """

    def __init__(self, service: BatchService, stop: asyncio.Event):
        """Hold the service; `stop` is the event by which waiting ends."""
        self.service, self._stop = service, stop
        self._failed = False  # whether the service's last commit failed

    def unpublished(self) -> list[Output]:
        """Return outputs that were committed before a restart and may not have been published."""
        return retry_while_away(self.service.unpublished, self._stop)

    def take(self, payloads: Sequence[Payload]) -> list[Output]:
        """Let the service take a batch, once its store is there."""
        return retry_while_away(lambda: self._take_and_recall(payloads), self._stop)

    def _take_and_recall(self, payloads: Sequence[Payload]) -> list[Output]:
        """Take a batch; return its outputs, and before them those that a failed commit left unpublished.

        A store that goes away during a commit may have completed it. Its outputs were then not published.
        """
        unpublished = self.service.unpublished() if self._failed else []
        try:
            outputs = self.service.take(payloads)
        except AwayError:
            self._failed = True
            raise
        self._failed = False
        return unpublished + outputs

    def published(self, outputs: Sequence[Output]) -> None:
        """Pass on that outputs were published."""
        self.service.published(outputs)

    def finish(self, ended: bool) -> list[Output]:
        """Let the service commit everything, and return its last outputs. `ended`: no more messages can come."""
        return retry_while_away(lambda: self.service.finish(ended), self._stop)
