"""What every transport must do: a broker in memory does it, and each way of failing is found."""

import asyncio
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import pytest

from heliograph.serving.brokers.transport import Batch
from heliograph.serving.brokers.transport_contract import check_transport
from heliograph.serving.output import Output


class Memory:
    """A broker in memory; a subclass breaks one promise. It keeps messages, and how many were acknowledged."""

    def __init__(self) -> None:
        self.messages: list[bytes] = []
        self.outputs: list[bytes] = []
        self.converged = 0

    def transport(self) -> "Reader":
        return Reader(self)

    async def send(self, bodies: Sequence[bytes]) -> None:
        self.messages += bodies

    async def published(self) -> list[bytes]:
        return list(self.outputs)

    def batch(self, read: int) -> list[bytes]:
        return self.messages[read : read + 7]

    def acknowledged(self, upto: int) -> None:
        self.converged = upto

    async def publish(self, outputs: Sequence[Output]) -> None:
        self.outputs += [output.body for output in outputs]


class Reader:
    """The service's side."""

    def __init__(self, broker: Memory) -> None:
        self.broker, self.read = broker, broker.converged

    async def receive(self) -> Batch | None:
        while not (result := self.broker.batch(self.read)):
            await asyncio.sleep(0.01)
        self.read = upto = self.read + len(result)

        async def acknowledge() -> None:
            self.broker.acknowledged(upto)

        return Batch(result, acknowledge)

    async def publish(self, outputs: Sequence[Output]) -> None:
        await self.broker.publish(outputs)

    async def close(self) -> None: ...


class Forgets(Memory):
    """What was given is gone, whether acknowledged or not."""

    def batch(self, read: int) -> list[bytes]:
        result = super().batch(read)
        self.converged = read + len(result)
        return result


class NeverSettles(Memory):
    """Acknowledging does nothing."""

    def acknowledged(self, upto: int) -> None: ...


class Shuffles(Memory):
    """Batches are turned round."""

    def batch(self, read: int) -> list[bytes]:
        return super().batch(read)[::-1]


class Cuts(Memory):
    """Long messages are cut."""

    async def send(self, bodies: Sequence[bytes]) -> None:
        self.messages += [body[:1000] for body in bodies]


class Skips(Memory):
    """What was sent while nobody read is lost."""

    def transport(self) -> Reader:
        reader = super().transport()
        reader.read = len(self.messages)
        return reader


class Repeats(Memory):
    """The same comes again and again, at once, and nothing else."""

    def batch(self, read: int) -> list[bytes]:
        return [b"{}"]


class TellsLater(Memory):
    """`publish` returns before anything is out, and then the process ends."""

    async def publish(self, outputs: Sequence[Output]) -> None: ...


class TellsBackwards(Memory):
    """The last goes out first."""

    async def publish(self, outputs: Sequence[Output]) -> None:
        self.outputs += [output.body for output in outputs][::-1]


class Ends(Memory):
    """It takes silence for the end."""

    def transport(self) -> Reader:
        class Short(Reader):
            async def receive(self) -> Batch | None:
                return await super().receive() if self.broker.batch(self.read) else None

        return Short(self)


class Sleeps(Memory):
    """Closing never comes to an end."""

    def transport(self) -> Reader:
        class Stays(Reader):
            async def close(self) -> None:
                await asyncio.sleep(60)

        return Stays(self)


def test_a_broker_in_memory_keeps_all_promises():
    assert check_transport(Memory(), patience=5.0)


class Late(Memory):
    """What comes again comes after what is new."""

    def transport(self) -> Reader:
        self.messages[self.converged :] = self.messages[self.converged :][::-1]
        return super().transport()


def test_another_order_of_what_comes_again_is_allowed_and_informed():
    assert not check_transport(Late(), patience=5.0)


BROKEN = [
    (Forgets, "receive: expected .* did not come"),
    (NeverSettles, "acknowledge: expected nothing to come again"),
    (Shuffles, "receive: expected new messages in order"),
    (Cuts, "receive: expected 1 messages within 1 s, 1 did not come"),
    (Skips, "receive: expected .* did not come"),
    (Repeats, "receive: expected 1 messages within 0.3 s, 1 did not come"),  # it takes a processor for itself
    (TellsLater, "publish: expected 100 outputs at the broker, 100 are not"),
    (TellsBackwards, "publish: expected the outputs in order"),
    (Ends, "receive: .* got None"),
    (Sleeps, "close: expected an end within 1 s"),
]


@pytest.fixture(scope="module")
def checks() -> Iterator[dict[type[Memory], Future[bool]]]:
    """Checks of all brokers that break a promise, which wait side by side."""
    with ThreadPoolExecutor(len(BROKEN)) as pool:
        yield {
            broker: pool.submit(check_transport, broker(), patience=0.3 if broker is Repeats else 1.0)
            for broker, _ in BROKEN
        }


@pytest.mark.slow
@pytest.mark.parametrize(("broker", "what"), BROKEN)
def test_a_broken_promise_is_found(checks: dict[type[Memory], Future[bool]], broker: type[Memory], what: str):
    with pytest.raises(AssertionError, match=what):
        checks[broker].result()
