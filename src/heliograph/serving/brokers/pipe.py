"""Transport over pipes, a message a line: all lines that are there form a batch; a slow reader slows the sender."""

import asyncio
import os
from collections.abc import Callable, Sequence

from heliograph.disk.whole_file import naming
from heliograph.serving.brokers.transport import Batch, nothing
from heliograph.serving.message import LONGEST
from heliograph.serving.output import Output

READ = 1 << 18  # bytes that are read at once
AT_ONCE = 4096  # bytes that a pipe takes without waiting, once it takes any


class Pipe:
    """Messages from one file descriptor, outputs to another, one a line. Empty lines are ignored.

    A line longer than LONGEST bytes is cut there, and the rest of it is skipped.

    Args:
        source: file descriptor of the messages (default 0, standard input).
        target: file descriptor of the outputs (default 1, standard output).
    """

    def __init__(self, source: int = 0, target: int = 1):
        self.source, self.target = source, target
        self._rest, self._skipping = b"", False

    async def receive(self) -> Batch | None:
        loop = asyncio.get_running_loop()
        while True:
            await _ready(self.source, loop.add_reader, loop.remove_reader)
            with naming("standard input"):
                data = os.read(self.source, READ)
            if lines := self._lines(data):
                return Batch(lines, nothing)
            if not data:
                return None

    def _lines(self, data: bytes) -> list[bytes]:
        """Return the lines that are complete with these bytes; at the end of the file, the incomplete last one."""
        *lines, rest = (self._rest + data).split(b"\n") if data else [self._rest, b""]
        if self._skipping and lines:
            del lines[0]
            self._skipping = False
        if len(rest) > LONGEST:
            if not self._skipping:
                lines.append(rest)
            rest, self._skipping = b"", True
        self._rest = rest
        return [line for line in lines if line.strip()]

    async def publish(self, outputs: Sequence[Output]) -> None:
        rest = memoryview(b"".join([output.body + b"\n" for output in outputs]))
        loop = asyncio.get_running_loop()
        while rest:
            await _ready(self.target, loop.add_writer, loop.remove_writer)
            with naming("standard output"):
                rest = rest[os.write(self.target, rest[:AT_ONCE]) :]

    async def close(self) -> None:
        """Do nothing: whoever opened the files closes them."""


async def _ready(file: int, add: Callable[[int, Callable[[], None]], None], remove: Callable[[int], object]) -> None:
    """Wait until a file can be used without blocking, so that the wait itself can be cancelled."""
    ready = asyncio.Event()
    try:
        add(file, ready.set)
    except PermissionError:  # a file on disk: it never waits
        return
    try:
        await ready.wait()
    finally:
        remove(file)
