"""Failures of a campaign, with all that is needed to repeat them alone."""

import json
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path

from heliograph.campaign.definition import Campaign, Setting
from heliograph.campaign.jobs import Job, Reply
from heliograph.disk.atomic_files import name_path_in_errors, replace

FAILURES = "failures.json"


@dataclass(frozen=True)
class FailedJob:
    """A chunk, or a whole setting where `chunk` is None, that failed every time.

    `runs` are the first and the last; `key` is the campaign's seed and the numbers that are folded into its key for the
    setting.
    """

    setting: int
    parameters: Setting
    chunk: int | None
    runs: tuple[int, int]
    key: tuple[int, int, int]
    error: str
    traceback: str
    command: str  # that repeats it alone

    def __str__(self) -> str:
        """Describe in one line what failed and why."""
        values = ", ".join(f"{name}={value!r}" for name, value in self.parameters.items())
        return f"setting {self.setting} ({values}), runs {self.runs[0]} to {self.runs[1]}: {self.error}"


def read_failures(out: Path) -> list[FailedJob]:
    """Read failures.json next to the store; return an empty list if there is no such file."""
    path = out / FAILURES
    return [FailedJob(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))] if path.is_file() else []


def make_failed_job(campaign: Campaign, out: Path, job: Job, reply: Reply) -> FailedJob:
    """Return the failure of a job, from its last reply, with everything that is needed to repeat it."""
    # A job without a chunk builds the setting's network, so its failure concerns all the setting's runs.
    all_chunks = campaign.chunks(job.setting)
    chunks = all_chunks if job.chunk is None else [all_chunks[job.chunk]]
    return FailedJob(
        setting=job.setting,
        parameters=campaign.settings[job.setting],
        chunk=job.chunk,
        runs=(chunks[0].start, chunks[-1].stop - 1),
        key=(campaign.seed, *campaign.words(job.setting)),
        error=reply.error,
        traceback=reply.traceback,
        command=_write_command(campaign, out, job),
    )


def write_failures(out: Path, failures: list[FailedJob], tried: list[Job]) -> None:
    """Write failures.json next to the store; without failures, remove the file.

    It holds these failures, and earlier ones that were not tried again. A setting that failed as a whole counts as
    tried again if one of its chunks was tried.
    """
    path = out / FAILURES
    partial = path.with_name(f".{path.name}.partial")
    jobs = {*tried, *(Job(job.setting) for job in tried)}  # a job without a chunk is that of the setting as a whole
    earlier = [failure for failure in read_failures(out) if Job(failure.setting, failure.chunk) not in jobs]
    entries = [asdict(failure) for failure in (*earlier, *failures)]
    if not entries:
        path.unlink(missing_ok=True)
        partial.unlink(missing_ok=True)  # left by a process that was killed
        return
    with name_path_in_errors(path):
        partial.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    replace(partial, path)


def _write_command(campaign: Campaign, out: Path, job: Job) -> str:
    """Return the command that repeats a failure, alone and in one process."""
    words = ["heliograph", "sweep", campaign.path, "--out", str(out.absolute()), "--setting", str(job.setting)]
    return shlex.join(words if job.chunk is None else [*words, "--chunk", str(job.chunk)])
