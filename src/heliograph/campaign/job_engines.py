"""Engines that do the jobs of a campaign: in this process, in worker processes, or on a Dask cluster.

An engine is a context that provides a function from jobs to (job, reply) in any order. A job whose worker dies has a
reply too, or is done by another worker.
"""

import json
import logging
import math
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from threading import Event, Thread, Timer
from typing import Any

from heliograph.campaign.jobs import Job, Reply, perform_job
from heliograph.numerics.check import fail

Engine = Callable[[Iterable[Job]], Iterator[tuple[Job, Reply]]]
TIMEOUT_MAX = threading.TIMEOUT_MAX  # the longest that a system waits
CONNECT = 10  # seconds in which a scheduler answers
LOOK = 0.01  # seconds between looks whether a cluster has done something
LOST = "scheduler", "one that goes on to the end", "a lost connection: the same command goes on with what is missing"
LOOK_AHEAD = 2  # jobs a cluster is given for each of its threads, so that none waits for this process

Untyped = Any  # what dask.distributed gives


def start_engine(
    campaign: str, store: Path, workers: int, scheduler: str | None = None, timeout: float = math.inf
) -> AbstractContextManager[Engine]:
    """Return a context manager of the engine, which takes jobs and yields each of them with its reply.

    It runs on the cluster of `scheduler` if that is given, else in `workers` processes, or in this process for 0.
    `campaign` is JSON, and `store` is the folder of the results. A job may take `timeout` seconds; in this process it
    has no limit.
    """
    if scheduler is not None:
        return run_on_cluster(campaign, store, scheduler, timeout)
    if workers == 0:
        return run_in_this_process(campaign, store)
    return run_in_processes(campaign, store, workers, timeout)


@contextmanager
def run_in_this_process(campaign: str, store: Path) -> Iterator[Engine]:
    """Yield an engine that does one job after another in this process."""
    yield lambda jobs: ((job, perform_job(campaign, str(store), job.setting, job.chunk)) for job in jobs)


@contextmanager
def run_in_processes(campaign: str, store: Path, workers: int, timeout: float = math.inf) -> Iterator[Engine]:
    """Yield an engine that does one job at a time in each worker process; a process that dies or hangs is replaced."""
    processes = [_WorkerProcess(campaign, store, timeout) for _ in range(workers)]
    try:
        yield lambda jobs: _distribute_jobs_to_workers(processes, deque(jobs))
    finally:
        for process in processes:
            process.stop()


def _distribute_jobs_to_workers(crew: list["_WorkerProcess"], waiting: deque[Job]) -> Iterator[tuple[Job, Reply]]:
    """Yield each of the waiting jobs with its reply, as they end.

    Each worker process of the `crew` has a thread here, which takes jobs for it and waits for its replies.
    """
    finished: queue.SimpleQueue[tuple[Job, Reply]] = queue.SimpleQueue()
    count = len(waiting)

    def take_jobs(worker: _WorkerProcess) -> None:
        """Take jobs from `waiting` and put each with its reply into `finished` until none waits or the worker stops."""
        while not worker.stopped:
            try:
                job = waiting.popleft()
            except IndexError:
                return
            finished.put((job, worker.get_reply(job)))

    for worker in crew:
        Thread(target=take_jobs, args=(worker,), daemon=True).start()
    for _ in range(count):
        yield finished.get()


class _WorkerProcess:
    """A worker process and the pipes to it: a job is a line of JSON, its reply another."""

    def __init__(self, campaign: str, store: Path, timeout: float):
        """Begin without a process, since the first job starts it.

        Args:
            campaign: the campaign as JSON.
            store: path of the store, into which the process writes.
            timeout: seconds that a job may take.
        """
        self.greeting = json.dumps([campaign, str(store)])  # the first line that a process reads
        self.timeout = timeout
        self.process: subprocess.Popen[str] | None = None
        self.stopped = False

    def get_reply(self, job: Job) -> Reply:
        """Send a job to the process and return its reply; if it dies or is too late, a reply that says so.

        A job is one chunk of the runs of one setting of a campaign. The process reads a job as a line of JSON, and
        answers with a line. After it died or was killed the next job gets a new process.
        """
        process = self._ensure_running()
        is_late = Event()

        def give_up() -> None:
            """Kill the process, and note that this was done because it is late."""
            is_late.set()
            process.kill()

        # A timer kills the process at the timeout; then reading its answer ends, with an empty line or part of one.
        timer = Timer(min(self.timeout, TIMEOUT_MAX), give_up)
        timer.daemon = True
        timer.start()
        _send_line(process, json.dumps([job.setting, job.chunk]))
        assert process.stdout is not None
        line = process.stdout.readline()
        timer.cancel()
        # A whole line is an answer unless the timer killed the process; else the process ended by itself or was killed.
        if line.endswith("\n") and not is_late.is_set():
            return Reply(**json.loads(line))
        code = process.wait()
        self._kill()
        if is_late.is_set():
            return _make_late_reply(self.timeout)
        return Reply(error=f"WorkerDied: the worker process ended with {_describe_exit(code)}")

    def _ensure_running(self) -> subprocess.Popen[str]:
        """Return the worker's process; it is started if there is none, and again if it has died."""
        if self.process is not None and self.process.poll() is not None:  # it died since its last job
            self._kill()
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "heliograph.campaign.worker_process"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                process_group=0,  # Ctrl-C in a terminal is for the parent, which decides
            )
            _send_line(self.process, self.greeting)
        return self.process

    def stop(self) -> None:
        """End the process; a chunk that it is computing leaves only a partial file."""
        self.stopped = True
        self._kill()

    def _kill(self) -> None:
        """Kill the worker's process, if there is one, and close its pipes."""
        process, self.process = self.process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                with suppress(OSError):  # text that waits in the pipe can no longer be written
                    pipe.close()


def _send_line(process: subprocess.Popen[str], line: str) -> None:
    """Send a line to a worker process; a dead process is noticed later, since no answer comes."""
    assert process.stdin is not None
    with suppress(OSError):  # the process is dead
        process.stdin.write(line + "\n")
        process.stdin.flush()


def _make_late_reply(timeout: float) -> Reply:
    """Return the reply in place of one that took longer than the timeout."""
    return Reply(error=f"TimedOut: no answer within {timeout:g} s, the campaign's timeout", late=True)


def _describe_exit(code: int) -> str:
    """Return how a process ended, in words; a code below zero is minus the signal that ended it."""
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


@contextmanager
def run_on_cluster(campaign: str, store: Path, address: str, timeout: float = math.inf) -> Iterator[Engine]:
    """Yield an engine that does jobs on a Dask cluster, whose workers have this package and see the store's folder.

    Dask repeats the jobs of a worker that dies. Jobs are given up when none came back for `timeout` seconds.

    Raises:
        ValueError: no scheduler at the address, or one that dies.
        ModuleNotFoundError: the extra `cluster` is not installed.
    """
    from distributed import Client

    start: Untyped = Client  # dask.distributed has no types
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what there is to say is said in one line
    try:
        client = start(address, set_as_default=False, timeout=CONNECT)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise fail(
            f"scheduler {address}", "the address of a Dask scheduler that answers", _format_error(error)
        ) from None
    try:
        yield lambda jobs: _run_jobs_on_cluster(client, campaign, str(store), deque(jobs), timeout)
    finally:
        _close_client(client)


def _close_client(client: Untyped) -> None:
    """Close the client of a cluster; errors are ignored, since a scheduler that is gone was reported before."""
    with suppress(OSError, RuntimeError, TimeoutError):
        client.close(timeout=CONNECT)


def _run_jobs_on_cluster(
    client: Untyped, campaign: str, store: str, waiting: deque[Job], timeout: float
) -> Iterator[tuple[Job, Reply]]:
    """Run jobs on a Dask cluster, a few more at once than it has threads; yield each with its reply, as they end.

    If no job ends within `timeout` seconds, all running jobs are given up, each with a reply that says so: the cluster
    may be dead.

    Args:
        client: Dask client of the cluster.
        campaign: definition of the campaign, as JSON.
        store: path of the store, which the workers see too.
        waiting: the jobs to run; each is removed when it is submitted.
        timeout: seconds without any reply after which to give up.
    """
    from distributed import as_completed

    running: dict[object, Job] = {}  # by future
    collect: Untyped = as_completed
    futures = collect(loop=client.loop)  # all that are added below; it yields those that are done
    while waiting or running:
        # Submit a few jobs more than the cluster has threads, so that none of them waits.
        threads = sum(_ask_cluster(client.nthreads).values())
        room = max(LOOK_AHEAD * threads, 1) - len(running)
        for _ in range(min(room, len(waiting))):
            job = waiting.popleft()
            future = client.submit(perform_job, campaign, store, job.setting, job.chunk, pure=False)
            running[future] = job
            futures.add(future)
        # Wait for any job; without one for too long, give all up.
        future = _wait_for_next_future(client, futures, timeout)
        if future is None:
            client.cancel(list(running))
            yield from ((job, _make_late_reply(timeout)) for job in running.values())
            return
        yield running.pop(future), _read_reply(future)


def _wait_for_next_future(client: Untyped, futures: Untyped, timeout: float) -> Untyped:
    """Return the next future (job on the cluster) that is done, or None after `timeout` seconds without one.

    It looks each LOOK seconds. LOST holds the words of the error.

    Raises:
        ValueError: the connection to the cluster is lost.
    """
    waited = 0.0
    while not futures.has_ready():
        if client.status != "running":
            raise fail(*LOST)
        if waited >= timeout:
            return None
        time.sleep(LOOK)
        waited += LOOK
    return _ask_cluster(lambda: next(futures))


def _ask_cluster(ask: Callable[[], Untyped]) -> Untyped:
    """Return the result of `ask`, which talks to the cluster; if it fails, raise the error that the cluster is lost."""
    try:
        return ask()
    except (OSError, RuntimeError, TimeoutError):
        raise fail(*LOST) from None


def _format_error(error: Exception) -> str:
    """Return an error as one line, with its class."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def _read_reply(future: Untyped) -> Reply:
    """Return the reply of a finished job, or a reply with the error if the job failed."""
    if future.status == "finished":
        reply: Reply = future.result()
        return reply
    error = future.exception() if future.status == "error" else RuntimeError(f"the task was {future.status}")
    return Reply(error=_format_error(error))
