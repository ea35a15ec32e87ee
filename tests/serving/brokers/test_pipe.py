"""Pipes: lines however they are cut, readers that are slow, and a service that is asked to stop."""

import asyncio
import os
import signal
from contextlib import suppress
from threading import Event, Thread, Timer
from time import monotonic, sleep

import pytest

from heliograph.serving import service_loop
from heliograph.serving.brokers.pipe import Pipe
from heliograph.serving.output import Output
from heliograph.serving.service import Service
from heliograph.serving.service_loop import keep_running
from heliograph.serving.storage import InMemoryStore
from tests.serving.worlds import fleet, lines, messages, stepping

LONGEST = 1 << 20  # bytes of a message


def fed(parts):
    """What a pipe receives of these bytes, written one after another."""
    source, end = os.pipe()

    def write():
        for part in parts:
            os.write(end, part)
            sleep(0.005)
        os.close(end)

    async def read():
        pipe, results = Pipe(source, 1), []
        while (batch := await pipe.receive()) is not None:
            results += batch.payloads
        return results

    writer = Thread(target=write)
    writer.start()
    try:
        return asyncio.run(read())
    finally:
        writer.join()
        os.close(source)


def test_lines_are_whole_however_they_are_cut():
    assert fed([b"a", b"b\nc\n\n", b"d", b"\n \ne"]) == [b"ab", b"c", b"d", b"e"]
    assert fed([]) == []


def test_a_carriage_return_ends_lines_that_come_one_by_one():
    # What follows it comes in the next piece: only then is it known that no newline does.
    assert fed([b"one\r", b"two\r", b"three\r"]) == [b"one", b"two", b"three"]
    assert fed([b"one\r", b"\ntwo\r\n", b"three"]) == [b"one\r", b"two\r", b"three"]


def test_a_line_without_an_end_is_bounded(monkeypatch):
    result = fed([b"a\n" + b"x" * 60_000 for _ in range(LONGEST // 60_000 + 3)] + [b"\nb\n"])
    assert result[0] == b"a" and result[-1] == b"b" and max(map(len, result)) <= LONGEST + 262_144
    result = fed([b"x" * 60_000 for _ in range(2 * LONGEST // 60_000)] + [b"yy\nb\n"])
    assert [len(line) > LONGEST for line in result] == [True, False] and result[-1] == b"b"


def test_a_full_disk_and_a_folder_are_named(tmp_path):
    full, folder = os.open("/dev/full", os.O_WRONLY), os.open(tmp_path, os.O_RDONLY)
    try:
        with pytest.raises(OSError, match="No space left") as error:
            asyncio.run(Pipe(0, full).publish([Output(1, "p", "final", b"x")]))
        assert error.value.filename == "standard output"
        with pytest.raises(OSError, match="directory") as error:
            asyncio.run(Pipe(folder, 1).receive())
        assert error.value.filename == "standard input"
    finally:
        os.close(full)
        os.close(folder)


def test_files_on_disk_are_pipes_too(tmp_path):
    (tmp_path / "in").write_bytes(b"\n".join(lines(messages(1, 10, 0, whole=True))))
    with (tmp_path / "in").open("rb") as source, (tmp_path / "out").open("wb") as target:
        service = Service(fleet(stepping()), InMemoryStore())
        asyncio.run(keep_running(service, Pipe(source.fileno(), target.fileno())))
    known = (tmp_path / "out").read_bytes()
    assert known.endswith(b"\n") and known.count(b'"kind":"final"') == 5


class Counting:
    """A service that tells a lot of each message, and remembers how often it was asked."""

    def __init__(self):
        self.taken = self.known = self.finished = 0

    def unpublished(self):
        return []

    def take(self, payloads):
        self.taken += len(payloads)
        return [Output(None, "", "provisional", b"x" * 10_000) for _ in payloads]

    def published(self, outputs):
        self.known += len(outputs)

    def finish(self, ended):
        self.finished += 1
        return []


def serve(service, source, target, after):
    """Keep a service running that is asked to stop after this many seconds."""
    timer = Timer(after, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    before = signal.getsignal(signal.SIGTERM)
    asyncio.run(keep_running(service, Pipe(source, target)))
    timer.join()
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_slow_reader_slows_the_sender_and_stopping_waits_for_it_no_longer_than_it_must(monkeypatch):
    monkeypatch.setattr(service_loop, "PATIENCE", 0.2)
    (source, sender), (reader, target) = os.pipe(), os.pipe()
    os.set_blocking(sender, False)
    service, written = Counting(), 0

    def send():
        nonlocal written
        for _ in range(100):
            with suppress(BlockingIOError):
                written += os.write(sender, b"m\n" * 1000)
            sleep(0.005)

    sending = Thread(target=send)
    sending.start()
    serve(service, source, target, after=0.4)  # nobody reads
    sending.join()
    assert service.known == 0 and service.finished == 2
    assert written <= 2 * service.taken + 65_536 < 200_000  # the pipe is full, and nothing is held in memory beyond it
    for end in (source, sender, reader, target):
        os.close(end)


def test_a_service_that_is_said_to_stop_tells_what_it_took():
    (source, sender), (reader, target) = os.pipe(), os.pipe()
    service = Service(fleet(stepping()), InMemoryStore())
    os.write(sender, b"".join(line + b"\n" for line in lines(messages(1, 10, 0, whole=True))))
    serve(service, source, target, after=0.3)
    os.close(target)
    with os.fdopen(reader, "rb") as known:
        assert b'"kind":"provisional"' in known.read()
    os.close(source)
    os.close(sender)


def test_a_reader_that_went_away_ends_the_service():
    (source, sender), (reader, target) = os.pipe(), os.pipe()
    os.close(reader)
    os.write(sender, b"m\n")
    with pytest.raises(BrokenPipeError):
        asyncio.run(keep_running(Counting(), Pipe(source, target)))
    for end in (source, sender, target):
        os.close(end)


def test_a_sender_that_is_ahead_fills_a_batch_and_a_reader_gets_all_of_it():
    """More than a pipe holds is one batch in, and out through a pipe that stays one that waits."""
    (source, sender), (reader, target) = os.pipe(), os.pipe()
    sent, known = b"m\n" * 100_000, []

    async def echo():
        pipe = Pipe(source, target)
        batch = await pipe.receive()
        await pipe.publish([Output(None, "", "provisional", body) for body in batch.payloads])
        return len(batch.payloads)

    def send():
        view = memoryview(sent)[65_536:]
        with suppress(BrokenPipeError):
            while view:
                view = view[os.write(sender, view) :]

    os.write(sender, sent[:65_536])  # what a pipe holds
    with os.fdopen(reader, "rb") as answers:
        threads = [Thread(target=send), Thread(target=lambda: known.append(answers.read()))]
        for thread in threads:
            thread.start()
        count = asyncio.run(echo())
        assert os.get_blocking(target)
        os.close(source)
        os.close(target)
        for thread in threads:
            thread.join()
    os.close(sender)
    assert 32_768 <= count <= 100_000 and known == [sent[: 2 * count]]


def test_a_service_that_computes_when_it_is_said_to_stop_is_not_waited_for(monkeypatch, caplog):
    """As where it compiles programs, which cannot be interrupted: what it was taking comes again."""
    monkeypatch.setattr(service_loop, "PATIENCE", 0.1)
    (source, sender), (reader, target) = os.pipe(), os.pipe()
    service, computed = Counting(), Event()
    monkeypatch.setattr(service, "take", lambda payloads: computed.wait(60) and [])
    os.write(sender, b"m\n")
    begun = monotonic()
    serve(service, source, target, after=0.3)
    assert monotonic() - begun < 20 and service.finished == 0
    assert "not committed" in caplog.text
    computed.set()
    for end in (source, sender, reader, target):
        os.close(end)
