"""Where jobs are done: in this process, in worker processes of this machine, or on a Dask cluster.

An engine is a context that gives a function from jobs to (job, reply) in any order. A job whose worker dies has a reply
too, or is done by another worker.
"""

import json
import queue
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import Any

from heliograph.campaign.work import Job, Reply, perform

Engine = Callable[[Iterable[Job]], Iterator[tuple[Job, Reply]]]
LOOK_AHEAD = 2  # jobs a cluster is given for each of its threads, so that none waits for this process


def start_engine(
    campaign: str, store: Path, workers: int, scheduler: str | None = None
) -> AbstractContextManager[Engine]:
    """The engine on the cluster of a scheduler; else with so many worker processes; else, for none, in this process."""
    if scheduler is not None:
        return on_cluster(campaign, store, scheduler)
    return in_processes(campaign, store, workers) if workers else in_this_process(campaign, store)


@contextmanager
def in_this_process(campaign: str, store: Path) -> Iterator[Engine]:
    """One job after another, here."""
    yield lambda jobs: ((job, perform(campaign, str(store), job.setting, job.chunk)) for job in jobs)


@contextmanager
def in_processes(campaign: str, store: Path, workers: int) -> Iterator[Engine]:
    """As many jobs at a time as there are worker processes; one that dies is replaced."""
    crew = [_Worker(campaign, store) for _ in range(workers)]
    try:
        yield lambda jobs: _share(crew, deque(jobs))
    finally:
        for worker in crew:
            worker.stop()


def _share(crew: list["_Worker"], waiting: deque[Job]) -> Iterator[tuple[Job, Reply]]:
    finished: queue.SimpleQueue[tuple[Job, Reply]] = queue.SimpleQueue()
    count = len(waiting)

    def serve(worker: _Worker) -> None:
        while not worker.stopped:
            try:
                job = waiting.popleft()
            except IndexError:
                return
            finished.put((job, worker.ask(job)))

    for worker in crew:
        Thread(target=serve, args=(worker,), daemon=True).start()
    for _ in range(count):
        yield finished.get()


class _Worker:
    """A worker process and the pipes to it."""

    def __init__(self, campaign: str, store: Path):
        self.greeting = json.dumps([campaign, str(store)])
        self.process: subprocess.Popen[str] | None = None
        self.stopped = False

    def ask(self, job: Job) -> Reply:
        """Have a job done; a process that dies over it is replaced when the next job comes."""
        process = self._alive()
        _say(process, json.dumps([job.setting, job.chunk]))
        assert process.stdout is not None
        line = process.stdout.readline()
        if line.endswith("\n"):
            return Reply(**json.loads(line))
        code = process.wait()
        self._end()
        return Reply(error=f"WorkerDied: the worker process ended with {_ending(code)}")

    def _alive(self) -> subprocess.Popen[str]:
        if self.process is not None and self.process.poll() is not None:  # it died since its last job
            self._end()
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "heliograph.campaign.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                encoding="utf-8",
            )
            _say(self.process, self.greeting)
        return self.process

    def stop(self) -> None:
        """End the process; a chunk that it is at leaves no trace but a partial file."""
        self.stopped = True
        self._end()

    def _end(self) -> None:
        process, self.process = self.process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                with suppress(OSError):  # what it was still to read cannot be written
                    pipe.close()


def _say(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    with suppress(OSError):  # it is dead: the answer, which does not come, will say so
        process.stdin.write(line + "\n")
        process.stdin.flush()


def _ending(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


@contextmanager
def on_cluster(campaign: str, store: Path, address: str) -> Iterator[Engine]:
    """On a Dask cluster whose workers have this package and see the store's folder; it does again what a dead one had.

    Raises:
        OSError: no scheduler at the address.
        ModuleNotFoundError: the extra `cluster` is not installed.
    """
    from distributed import Client

    start: Any = Client  # it has no types
    with start(address, set_as_default=False) as client:
        yield lambda jobs: _submit(client, campaign, str(store), deque(jobs))


def _submit(client: Any, campaign: str, store: str, waiting: deque[Job]) -> Iterator[tuple[Job, Reply]]:
    from distributed import as_completed

    jobs: dict[object, Job] = {}
    collect: Any = as_completed
    flying = collect(loop=client.loop)
    while waiting or jobs:
        room = max(LOOK_AHEAD * sum(client.nthreads().values()), 1) - len(jobs)
        for _ in range(min(room, len(waiting))):
            job = waiting.popleft()
            future = client.submit(perform, campaign, store, job.setting, job.chunk, pure=False)
            jobs[future] = job
            flying.add(future)
        future = next(flying)
        yield jobs.pop(future), _result(future)


def _result(future: Any) -> Reply:
    if future.status == "finished":
        reply: Reply = future.result()
        return reply
    error = future.exception() if future.status == "error" else RuntimeError(f"the task was {future.status}")
    return Reply(error=f"{type(error).__name__}: {' '.join(str(error).split())}")
