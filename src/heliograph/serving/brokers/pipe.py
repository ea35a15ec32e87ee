"""Transport over pipes, a message a line: all lines that are there form a batch; a slow reader slows the sender."""

import asyncio
import os
import re
import select
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Protocol

from heliograph.disk.atomic_files import name_path_in_errors
from heliograph.files.text.text_stream import TextStream
from heliograph.serving.brokers.transport import LOG, Batch, acknowledge_nothing
from heliograph.serving.message import LONGEST, Payload
from heliograph.serving.output import Output

READ = 1 << 20  # bytes of a batch
FULL = 1 << 15  # bytes that show that the sender is ahead, so that we wait for more
MORE = 2  # milliseconds that we wait for more
AT_ONCE = 4096  # bytes that a pipe takes without waiting, once it takes any


class MessageReader(Protocol):
    """What makes messages of lines."""

    source: str

    def read(self, lines: Sequence[bytes]) -> list[Payload]:
        """Return the messages of lines that are not empty."""

    def end(self) -> list[Payload]:
        """Return the messages of what is left at the end."""


class Pipe:
    """Messages from one file descriptor, outputs to another, one a line. Empty lines are ignored.

    What is packed (gzip) is unpacked, and UTF-16 read. A line longer than LONGEST bytes is cut
    there, and the rest of it is skipped.

    Args:
        source: file descriptor of the messages (default 0, standard input).
        target: file descriptor of the outputs (default 1, standard output).
        reader: what makes messages of lines; None takes every line for a message.
    """

    def __init__(self, source: int = 0, target: int = 1, reader: MessageReader | None = None):
        """Prepare to read lines from the descriptor `source` by a reader, and to write to the descriptor `target`."""
        self.source, self.target, self._reader = source, target, reader
        self._lines = _LineSplitter()
        self._has_warned = False  # that bytes could not be unpacked
        # Unpacks bytes that are packed, and decodes UTF-16.
        self._text = TextStream("standard input" if reader is None else reader.source)

    async def receive(self) -> Batch | None:
        """Wait for lines of standard input, and return their messages; None at its end."""
        while True:
            # Packed bytes that were read before may have more text in them: then no more bytes are waited for.
            data, ended = b"", False
            if not self._text.has_more:
                data = await self._wait_for_bytes()
                ended = not data
            text = self._text.feed(data, ended)
            lines = self._lines.split(text, ended and not self._text.has_more)
            payloads: list[Payload] = list(lines) if self._reader is None else self._reader.read(lines)
            if ended:
                payloads += [] if self._reader is None else self._reader.end()
                self._warn_if_broken()
            if payloads:
                return Batch(payloads, acknowledge_nothing)
            if ended:
                return None

    async def _wait_for_bytes(self) -> bytes:
        """Return the next bytes of the source, once there are any; b"" at its end."""
        loop = asyncio.get_running_loop()
        await _wait_until_ready(self.source, loop.add_reader, loop.remove_reader)
        with name_path_in_errors("standard input"):
            return self._read_available()

    def _warn_if_broken(self) -> None:
        """Warn, once, that what came (`_text`, which may be compressed) could not be unpacked to its end."""
        if self._text.broken and not self._has_warned:
            self._has_warned = True
            LOG.warning("%s", self._text.broken)

    def _read_available(self) -> bytes:
        """Return the bytes that are there, at most READ.

        If there are FULL bytes or more, the sender is ahead. Then wait up to MORE milliseconds for further bytes, again
        and again.
        """
        data = next_bytes = os.read(self.source, READ)
        poll = select.poll()
        poll.register(self.source, select.POLLIN)
        while next_bytes and FULL <= len(data) < READ and poll.poll(MORE):
            next_bytes = os.read(self.source, READ - len(data))
            data += next_bytes
        return data

    async def publish(self, outputs: Sequence[Output]) -> None:
        """Write outputs to standard output, a line each, waiting while the pipe is full."""
        rest = memoryview(b"".join([output.body + b"\n" for output in outputs]))
        loop = asyncio.get_running_loop()
        with _set_nonblocking(self.target) as (target, at_once):
            while rest:
                await _wait_until_ready(target, loop.add_writer, loop.remove_writer)
                with name_path_in_errors("standard output"), suppress(BlockingIOError):
                    rest = rest[os.write(target, rest[:at_once]) :]

    async def close(self) -> None:
        """Do nothing: whoever opened the files closes them."""


class _LineSplitter:
    """Cuts bytes that come in pieces into lines.

    Lines end with a newline, or, where there is none, with a carriage return. Of a line longer than LONGEST one byte
    more than that is returned, so that its reader refuses it, and the rest of it is skipped.
    """

    def __init__(self) -> None:
        """Begin before the first byte."""
        self._rest = b""  # the beginning of a line that has not ended
        self._newline: bytes | None = None  # the byte that ends lines; None until it is known
        self._is_skipping = False  # whether the present line was too long, so that its rest is skipped

    def split(self, data: bytes, ended: bool) -> list[bytes]:
        """Return the lines that are complete with these bytes, but for blank ones.

        `ended`: no more bytes will come, so that the last line needs no end.
        """
        if self._newline is None:
            self._newline = self._find_newline(self._rest + data)
        *lines, rest = (self._rest + data).split(self._newline or b"\n")
        if ended:
            lines, rest = [*lines, rest], b""
        if self._is_skipping and lines:  # the first of these is the end of the line that was too long
            del lines[0]
            self._is_skipping = False
        if len(rest) > LONGEST:
            if not self._is_skipping:
                lines.append(rest[: LONGEST + 1])
            rest, self._is_skipping = b"", True
        self._rest = rest
        return [line for line in lines if line.strip()]

    def _find_newline(self, data: bytes) -> bytes | None:
        """Return the byte that ends lines, or None as long as it is not known.

        It is known once something follows a newline or a carriage return, since a newline may follow a carriage return.
        A carriage return before a newline is blank, and counts to its line.
        """
        if re.search(rb"[\r\n].", data, re.DOTALL) is None:
            return None
        return b"\n" if b"\n" in data else b"\r"


@contextmanager
def _set_nonblocking(file: int) -> Iterator[tuple[int, int | None]]:
    """Yield a descriptor to write to, and how many bytes it takes at once without waiting; None for any number.

    Whether writing waits is a property of an open pipe, which all its users share. So the pipe is opened again, as one
    that does not wait. If that fails, AT_ONCE bytes are written at a time: a pipe that is ready takes as many.
    """
    mode, reopened = os.fstat(file).st_mode, None
    if stat.S_ISFIFO(mode):
        with suppress(OSError):
            reopened = os.open(f"/proc/self/fd/{file}", os.O_WRONLY | os.O_NONBLOCK)
    try:
        if reopened is not None:
            yield reopened, None
        else:
            yield file, None if stat.S_ISREG(mode) else AT_ONCE
    finally:
        if reopened is not None:
            os.close(reopened)


async def _wait_until_ready(
    file: int, add: Callable[[int, Callable[[], None]], None], remove: Callable[[int], object]
) -> None:
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
