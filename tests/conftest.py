"""What the test processes of one session share and let go: compiled programs, compiled in a hurry and kept on disk."""

import ctypes
import gc
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import jaxtyping
import pytest

from tests.parts import RealParts, started
from tests.shapes import where_shaped

FOLDER = "JAX_COMPILATION_CACHE_DIR"
IN_A_HURRY = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_disable_hlo_passes=hlo-verifier",
)

jaxtyping.jaxtyped = where_shaped  # what the import hook decorates the checked packages with

# Bytes of this machine; 0 where the system does not say.
MEMORY = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 0
# Bytes of a process before it lets go after a file, which takes a second, and since it last did.
MOST, GROWTH = min(max(MEMORY / 8, 1.6e9), 3e9), 0.2e9
PROGRAMS = 300  # in one context of the compiler
WITHIN = MOST + GROWTH  # before it lets go between two tests of a file, which share programs


def pytest_configure(config):
    """The first process sets the environment; workers and the commands that tests start find it there."""
    config.pluginmanager.register(RealParts())
    if FOLDER not in os.environ:
        os.environ[FOLDER] = config.compilations = tempfile.mkdtemp(prefix="heliograph-tests-")
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
        # Most programs run once, so that compiling them is what takes time: a fifth of it with these.
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
        # Each operation knows from which line it came; the compiler copies that with it, a tenth of its time.
        os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"
        # BLAS threads wait busily for matrices of a few rows: thirty times the processor time of a small L-BFGS-B.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        for flag in (" ".join(IN_A_HURRY), *IN_A_HURRY):  # all at once, or those that this release knows
            flags = f"{os.environ.get('XLA_FLAGS', '')} {flag}"
            if flag not in os.environ.get("XLA_FLAGS", "") and understood(flags):
                os.environ["XLA_FLAGS"] = flags


def understood(flags: str) -> bool:
    """Whether this release of the compiler knows these flags: one that does not ends the process that asks."""
    requested = [sys.executable, "-c", "from jaxlib import xla_client; xla_client.make_cpu_client()"]
    return subprocess.run(requested, env=os.environ | {"XLA_FLAGS": flags}, capture_output=True).returncode == 0


def pytest_unconfigure(config):
    """Remove the folder."""
    if hasattr(config, "compilations"):
        shutil.rmtree(config.compilations, ignore_errors=True)


LONG = (
    "tests/straightline/conformance/",
    "tests/studies/",
    "tests/test_docs.py",
    "tests/test_random_programs.py",
    "tests/test_readme.py",
    "tests/test_upper_claims.py",
    "tests/serving/",
)


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config, items):
    """Files that take long come first, so that no worker has one left when the other has none."""
    draw_no_constants_of_source()
    result = yield
    if hasattr(config, "workerinput"):  # each in the same order, whichever it collected in
        items.sort(key=lambda item: item.path)
    items.sort(key=lambda item: not item.nodeid.startswith(LONG))
    return result


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Every second worker imports the files from the end on: each file that is not compiled yet is compiled by one."""
    report = yield
    worker = getattr(collector.config, "workerinput", {}).get("workerid", "gw0")
    if isinstance(collector, pytest.Directory) and int(worker.removeprefix("gw")) % 2:
        report.result.reverse()
    return report


def draw_no_constants_of_source():
    """Let hypothesis draw none of the numbers that stand in the sources: an example in twenty has one.

    It parses all modules that are imported, 780 after collecting, for which a fresh clone takes 2 s a process; and what
    it draws would depend on which they are.
    """
    from hypothesis.internal.conjecture import providers

    if hasattr(providers, "_get_local_constants"):  # not in every release
        providers._get_local_constants = lambda: providers._local_constants  # none so far


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection():
    """What is imported stays: a quarter of the time of collecting was the collector's, which looked at it."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish():
    """What is imported stays: the collector need not look at it again and again while JAX traces, nor at each trace.

    The folder is for commands that tests start: in here hardly a program comes twice, and keeping each costs a tenth.
    """
    if "jax" in sys.modules:
        from jax.experimental.compilation_cache.compilation_cache import reset_cache

        sys.modules["jax"].config.update("jax_enable_compilation_cache", False)
        reset_cache()  # whether there is one is asked once, and what is collected may have asked
        keep_contexts()
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def keep_contexts():
    """Let JAX write some hundred programs in one context of its compiler, not each in a context of its own.

    Making one is a fifth of what compiling an operation costs. What a context was told it holds for good, constants
    too, so that one is let go in time; and each thread has its own.
    """
    from jax._src.interpreters import mlir

    if not hasattr(mlir, "make_ir_context"):  # another release of JAX
        return
    make, kept = mlir.make_ir_context, threading.local()

    def take():
        if getattr(kept, "programs", PROGRAMS) == PROGRAMS:
            kept.context, kept.programs = make(), 0
        kept.programs += 1
        return kept.context

    mlir.make_ir_context = take


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    """Tests trace from deep within pytest: they have room on the interpreter's stack."""
    from heliograph.numerics import reserve_stack

    return reserve_stack(item.config.pluginmanager.getplugin("runner").pytest_runtest_protocol)(item, nextitem)


@pytest.fixture
def collect_garbage():
    """Called, collects what the test let go: objects from before are not looked at, which takes seconds."""
    gc.collect(1)
    gc.disable()  # nothing of the test counts as old
    yield lambda: gc.collect(1)
    gc.enable()


@pytest.fixture(scope="session")
def memory_left():
    """Of this process after it let go, in bytes: a list, to which is added each time."""
    return [resident()]


@pytest.fixture(autouse=True, scope="module")
def bounded_memory(memory_left):
    """Compiled programs are let go of when they, and what the compiler left, are much: it takes time."""
    yield
    bound_memory(memory_left, MOST)


@pytest.fixture(autouse=True)
def bounded_memory_of_file(memory_left):
    """So are they in the middle of a file when there is no more memory: its other tests compile them again."""
    yield
    bound_memory(memory_left, WITHIN)


def bound_memory(memory_left, most):
    """Let go of all compiled programs if the process has more than so many bytes, and more than it last had left."""
    if resident() > max(most, memory_left[-1] + GROWTH):
        forget()
        memory_left.append(resident())


def resident():
    """Memory of this process, bytes; 0 where the system does not say."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else 0


def forget():
    """Let go of all compiled programs, the compiler's and heliograph's."""
    if "jax" in sys.modules:
        sys.modules["jax"].clear_caches()
        for module in [m for name, m in sys.modules.items() if name.startswith("heliograph.")]:
            for function in vars(module).values():
                if hasattr(function, "cache_clear"):
                    function.cache_clear()
        gc.collect()
        if hasattr(ctypes.CDLL(None), "malloc_trim"):  # glibc keeps what is freed
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="session")
def widths(tmp_path_factory):
    """One browser for all pages."""
    from tests.widths import Widths

    widths = Widths(tmp_path_factory.mktemp("pages") / "page.html")
    yield widths
    widths.close()


@pytest.fixture
def fits(widths, request):
    """Called with a page, fails if something there is wider than the window of a screen or of a phone."""
    if widths.there():
        started(request.node, "browser")
    return widths
