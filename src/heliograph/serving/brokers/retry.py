"""Repeated attempts with waits that grow, so that an absent broker is not contacted a hundred times a second."""

import asyncio
import logging
import random

LOG = logging.getLogger("heliograph.serving")
FIRST, LONGEST = 0.25, 30.0  # seconds


def still_needed() -> None:
    """Raise the cancellation again if this task was cancelled: a client may have swallowed it."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


class Retry:
    """Waits that double, each shortened at random by up to a half so that processes do not come back all at once."""

    def __init__(self, what: str):
        self.what, self._wait = what, FIRST

    async def wait(self, error: Exception) -> None:
        """Log the failure, and wait before the next attempt."""
        still_needed()
        wait = self._wait * random.uniform(0.5, 1.0)
        LOG.warning("%s: %s; trying again in %.1f s", self.what, type(error).__name__, wait)
        self._wait = min(2 * self._wait, LONGEST)
        await asyncio.sleep(wait)

    def worked(self) -> None:
        """Reset the wait after a success."""
        self._wait = FIRST
