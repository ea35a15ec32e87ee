"""Status of devices, online or offline, by their last messages, stored with the state of the plants."""

from collections.abc import Sequence

from heliograph.files.device_availability import DeviceStatuses
from heliograph.serving.message import Payload
from heliograph.serving.output import Output
from heliograph.serving.service_loop import BatchService
from heliograph.serving.storage.store_protocol import StoreProtocol


class DeviceStatusService:
    """A service that stores the last status of each device: one that was offline is so after a restart.

    Args:
        service: the service.
        statuses: the last statuses that devices sent; stored ones are restored into it.
        store: where they are stored.
    """

    def __init__(self, service: BatchService, statuses: DeviceStatuses, store: StoreProtocol):
        """Restore the stored statuses of the service's devices: online or offline."""
        self._service, self._statuses, self._store = service, statuses, store
        self._unkept = dict[str, int]()  # {topic: status as a number}, of statuses that the store does not have yet
        statuses.restore(store.words())

    def unpublished(self) -> list[Output]:
        """Return outputs that were committed before a restart and may not have been published."""
        return self._service.unpublished()

    def take(self, payloads: Sequence[Payload]) -> list[Output]:
        """Store the statuses that came before these messages, use the messages, and return the outputs to publish."""
        self._keep_statuses()
        return self._service.take(payloads)

    def published(self, outputs: Sequence[Output]) -> None:
        """Note that these outputs were published; the next commit records it."""
        self._service.published(outputs)

    def finish(self, ended: bool) -> list[Output]:
        """Commit everything, also statuses of devices; return the last outputs. `ended`: no more messages can come."""
        self._keep_statuses()
        return self._service.finish(ended)

    def _keep_statuses(self) -> None:
        """Store the statuses (online or offline) that devices have sent since the last call, the last of each topic."""
        # If the store cannot be reached, it raises, and the statuses stay in `_unkept` for the next call.
        self._unkept |= self._statuses.pop_changed_statuses()
        if self._unkept:
            self._store.keep_words(self._unkept)
            self._unkept = {}
