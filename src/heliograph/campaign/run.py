"""Run of a campaign: describe its settings, make the store, compute missing chunks, report failures."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import TypeAliasType

from heliograph.campaign.definition import Campaign
from heliograph.campaign.failed_jobs import FailedJob, make_failed_job, write_failures
from heliograph.campaign.job_engines import Engine, start_engine
from heliograph.campaign.jobs import Job, Reply
from heliograph.campaign.summary import SUMMARY, write_summary
from heliograph.campaign.zarr_store import (
    STORE,
    NetworkDescription,
    check_labels_within,
    check_same_campaign,
    create_store,
    find_described_settings,
    find_done_chunks,
    read_labels,
    remove_damaged_chunks,
    remove_partial_files,
    restore_labels,
    unite_labels,
    write_claims,
)
from heliograph.disk.atomic_files import check_folder_writable, check_only_results, lock_folder, remove_leftover_folders
from heliograph.numerics.check import check_count, check_progress, fail, file_path, instance
from heliograph.numerics.module import readable

TRIES = 3  # a job that fails is tried again after the others, in case its worker was to blame
Progress = TypeAliasType("Progress", Callable[[str, int, int], None])
# Called as accept(job, its value, how many jobs are done) for each job that succeeds.
Accept = Callable[[Job, NetworkDescription | None, int], None]


@readable
@dataclass(frozen=True)
class CampaignRun:
    """Result of a call of `run_campaign`.

    Attributes:
        folder: the results folder.
        already: number of chunks that were there before.
        computed: number of chunks that were computed.
        failures: chunks and settings that failed.
        damaged: files that did not agree with their checksums.
    """

    folder: Path
    already: int
    computed: int
    failures: list[FailedJob]
    damaged: list[Path]


def run_campaign(
    campaign: Campaign,
    out: str | Path,
    workers: int | None = None,
    scheduler: str | None = None,
    only: Sequence[tuple[int, int]] | None = None,
    progress: Progress | None = None,
) -> CampaignRun:
    """Compute what a campaign's results folder lacks: results.zarr, summary.csv, and failures.json if a chunk failed.

    A campaign simulates many settings of a model; the runs of a setting are divided into chunks, which are computed by
    themselves. The store's bytes depend on the campaign alone: neither on the workers, nor on how often and where it
    was interrupted. A chunk that fails is tried three times, then reported; one that takes longer than the campaign's
    `timeout` is reported at once; the others continue. A chunk whose files do not agree with their checksums is
    computed again. With 0 `workers` there is no timeout, so that a debugger can be used.

    Args:
        campaign: the campaign, from `load_campaign`.
        out: the results folder.
        workers: number of worker processes, by default one for each CPU; 0 computes in this process.
        scheduler: address of a Dask scheduler, used instead of worker processes (default none).
        only: (setting, chunk) pairs to compute; by default all.
        progress: called as progress(what, done, total) to report progress (default none).

    Raises:
        ValueError: a folder of something else or of another campaign, or one in use; a setting or chunk that does not
            exist, no setting that can be built, settings whose plants differ in their states; no scheduler at the
            address, or one that dies, in which case finished chunks are kept.
        ModuleNotFoundError: an extra, `sweep` or `cluster`, is not installed.
    """
    instance("campaign", campaign, Campaign, "one from load_campaign")
    check_progress(progress, "(what, done, total)")
    out, progress = file_path("results folder", out), progress or (lambda what, done, total: None)
    check_folder_writable(out)
    with lock_folder(out) as alone:
        if not alone:
            raise fail(f"results folder {out}", "no other campaign at work in it", "one that is")
        return _compute_missing(campaign, out, workers, scheduler, only, progress)


def _compute_missing(
    campaign: Campaign,
    out: Path,
    workers: int | None,
    scheduler: str | None,
    only: Sequence[tuple[int, int]] | None,
    progress: Progress,
) -> CampaignRun:
    """Compute the chunks that the store lacks, and write failures and summary; return what was done.

    A campaign is many simulations of a network under several settings; its runs are computed in chunks, and each chunk
    is stored when it is done. So an interrupted campaign goes on from there. Nobody else works in the folder `out`.

    Args:
        campaign: network, settings, number of runs and steps.
        out: folder with the store of results, the summary and the failures.
        workers: number of worker processes; None for one for each CPU, 0 to compute in this process.
        scheduler: address of a Dask scheduler, used instead of worker processes; None without one.
        only: pairs (setting, chunk) to compute; None for all.
        progress: called as progress(what, done, total).
    """
    # What an interrupted call left behind is removed; `missing` are the jobs without a complete chunk.
    store = (out / STORE).absolute()
    remove_leftover_folders(store)
    check_only_results(out, f"{STORE}/zarr.json")
    expected = _list_jobs(campaign, only)
    done, damaged = _remove_damaged_and_partial(store, campaign)
    missing = [job for job in expected if (job.setting, job.chunk) not in done]
    already = len(expected) - len(missing)
    if not missing and not damaged and (out / SUMMARY).is_file():
        return CampaignRun(out, already, computed=0, failures=[], damaged=[])
    failed: dict[Job, Reply] = {}
    if missing or damaged:
        count = _count_workers(workers, len(missing) or 1)  # one where only what was damaged is described again
        with start_engine(campaign.as_json(), store, count, scheduler, campaign.timeout) as engine:
            (out / SUMMARY).unlink(missing_ok=True)  # it is not right for what is computed now
            failed = _describe_settings_and_compute_chunks(engine, campaign, store, missing, already, progress)
    remove_partial_files(store)
    # Reports are written again after every call.
    failures = [make_failed_job(campaign, out, job, reply) for job, reply in failed.items()]
    write_failures(out, failures, tried=expected)
    write_summary(store, campaign, out / SUMMARY)
    # A job without a chunk is that of a setting, whose network could not be built.
    lacking = sum(1 for job in missing if job in failed or Job(job.setting) in failed)
    return CampaignRun(out, already, computed=len(missing) - lacking, failures=failures, damaged=damaged)


def _remove_damaged_and_partial(store: Path, campaign: Campaign) -> tuple[set[tuple[int, ...]], list[Path]]:
    """Remove damaged and partial files from a store; return the done chunks (setting, chunk), and the damaged files.

    Raises:
        ValueError: the store is of another campaign.
    """
    if not store.is_dir():
        return set(), []
    check_same_campaign(store, campaign)
    damaged = remove_damaged_chunks(store, campaign)
    remove_partial_files(store)
    return find_done_chunks(store, campaign), damaged


def _describe_settings_and_compute_chunks(
    engine: Engine,
    campaign: Campaign,
    store: Path,
    missing: Sequence[Job],
    already: int,
    progress: Progress,
) -> dict[Job, Reply]:
    """Describe new settings, then compute the missing chunks of those that can be built; return failures, in order.

    Args:
        engine: does jobs, and yields each with its reply.
        campaign: the campaign.
        store: path of the store.
        missing: the jobs of the chunks that are not there.
        already: number of chunks that are there, for `progress`.
        progress: called as progress(what, done, total).
    """
    failed = _prepare_store(engine, campaign, store, {job.setting for job in missing}, progress)
    possible = [job for job in missing if Job(job.setting) not in failed]
    total = already + len(missing)
    progress("simulating", already, total)
    failed |= _try_jobs(engine, possible, lambda job, value, done: progress("simulating", already + done, total))

    def order(failure: tuple[Job, Reply]) -> tuple[int, int]:
        """Return what a failure is sorted by: setting, then chunk; a setting that failed as a whole has no chunk."""
        job, _ = failure
        return job.setting, job.chunk or 0

    return dict(sorted(failed.items(), key=order))


def _list_jobs(campaign: Campaign, only: Sequence[tuple[int, int]] | None) -> list[Job]:
    """Return the chunks to compute, each once: all, or those of `only`, which must be the campaign's."""
    all_jobs = [Job(chunk.setting, chunk.number) for chunk in campaign.all_chunks()]
    if only is None:
        return all_jobs
    jobs, known = [*dict.fromkeys(Job(setting, chunk) for setting, chunk in only)], set(all_jobs)
    unknown = [job for job in jobs if job not in known]
    if unknown:
        last = all_jobs[-1]
        expected = f"a setting from 0 to {last.setting} and a chunk from 0 to {last.chunk}"
        raise fail("setting and chunk", expected, f"{unknown[0].setting} and {unknown[0].chunk}")
    return jobs


def _count_workers(workers: int | None, jobs: int) -> int:
    """Return how many processes work: `workers`, or by default one a processor, but at most one a job."""
    if workers is None:
        cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return min(cpus, jobs)
    return min(check_count("workers", workers, 0), jobs)


def _prepare_store(
    engine: Engine, campaign: Campaign, store: Path, settings: set[int], progress: Progress
) -> dict[Job, Reply]:
    """Make the store if needed, and describe in it the settings; return the jobs of settings that cannot be built.

    A setting is described by its labels, the names of its states, nodes and filters, which are those along the store's
    axes; and by its claims, what each filter says that its covariance is ("exact", "upper", ...).

    Args:
        engine: does the jobs that describe a setting: build its network, and return its labels and claims.
        campaign: the campaign.
        store: path of the store.
        settings: numbers of the settings of which chunks are to be computed.
        progress: called after each description, as progress(what, done, total).
    """
    is_new = not store.is_dir()
    if is_new:
        without_claims = list(range(len(campaign.settings)))
    else:
        # Of the settings to compute, and of those of which chunks are there: their claims may have been damaged, and
        # then removed.
        begun = {setting for setting, _ in find_done_chunks(store, campaign)}
        without_claims = sorted((settings | begun) - {setting for (setting,) in find_described_settings(store)})
    jobs = [Job(setting) for setting in without_claims]
    described: dict[int, NetworkDescription] = {}

    def accept(job: Job, description: NetworkDescription | None, done: int) -> None:
        """Keep the description of a job's setting in `described`, and show that `done` of all `jobs` are built."""
        assert description is not None  # these jobs only describe
        described[job.setting] = description
        progress("building", done, len(jobs))

    failed = _try_jobs(engine, jobs, accept)
    if is_new and not described:
        first = next(iter(failed.values()))
        raise fail("campaign", "a setting whose network can be built", f"none: setting 0 gave {first.error}")
    # A new store has the names of all settings along its axes; settings that come later must fit into them.
    labels = {setting: restore_labels(described[setting]["labels"]) for setting in sorted(described)}
    if is_new:
        create_store(store, campaign, unite_labels(labels))
    for setting, labels_of_setting in labels.items():
        check_labels_within(labels_of_setting, read_labels(store), setting)
        write_claims(store, setting, described[setting]["claims"])
    return failed


def _try_jobs(engine: Engine, jobs: Iterable[Job], accept: Accept) -> dict[Job, Reply]:
    """Do jobs, failed ones again, up to TRIES times; return those that still fail, with their last replies.

    A job that took too long is not repeated.

    Args:
        engine: does jobs, and yields each with its reply.
        jobs: the jobs.
        accept: called for each job that succeeds, with its value and the number of jobs done so far.
    """
    done, left = 0, {job: Reply() for job in jobs}
    given_up: list[Job] = []  # jobs that took too long
    for _ in range(TRIES):
        for job, reply in engine([job for job in left if job not in given_up]):
            if not reply.error:
                del left[job]
                done += 1
                accept(job, reply.value, done)
                continue
            left[job] = reply
            if reply.late:
                given_up.append(job)
        if len(left) == len(given_up):
            break
    return left
