"""Machine code from text of LLVM IR: quickly made code first (LLVM's level 0), optimised code (level 1) if it pays."""

import ctypes
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from threading import Lock, current_thread, main_thread

import jax
import llvmlite.binding as llvm

from straightline.llvm.module_text import FunctionSource
from straightline.lowering import turn_failures_into_refusals, warn_once
from straightline.nodes import Unsupported
from straightline.size_limits import OFTEN

Function = Callable[[int, int, int, int, int], None]
SIGNATURE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)


@cache
def find_llvm_target() -> llvm.Target:
    """Return the LLVM target of this machine.

    Raises:
        Unsupported: LLVM does not know the processor. A warning says so once.
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    try:
        return llvm.Target.from_default_triple()
    except RuntimeError as error:
        warn_once(f"no native code: expected a processor that LLVM knows, got {error}")
        raise Unsupported("LLVM does not know this processor") from None


@cache
def find_processor_features() -> tuple[str, str, bool]:
    """Return this processor's name and features for LLVM, and whether it has fused multiply-add."""
    flags = llvm.get_host_cpu_features()
    arm = "aarch64" in find_llvm_target().triple or "arm64" in find_llvm_target().triple
    return llvm.get_host_cpu_name(), flags.flatten(), bool(flags.get("fma")) or arm


class MachineCode:
    """Machine code of one text of LLVM IR; its function `run` may be called as long as this object exists.

    LLVM's optimisation passes find nothing more in straight lines, and would take as long as the generation of code.
    `level` is that of the generation: 0 for code that is quickly made, 1 for optimised code, whose registers are better
    assigned. `width` is the number of runs of a vector. Results have the same bits whatever both are.
    """

    def __init__(self, source: FunctionSource, level: int, width: int):
        """Generate machine code from a function's LLVM text, for vectors of `width` runs.

        `level` is LLVM's level of optimisation: 0 for code that is quickly made, 1 for optimised code.
        """
        self.level, self.width = level, width
        cpu, flags, *_ = find_processor_features()
        machine = find_llvm_target().create_target_machine(cpu=cpu, features=flags, opt=level)
        module = llvm.parse_assembly(source.text(width))
        module.verify()
        # Make an object file, which the engine only loads: an engine that made the code would verify the module again.
        code = llvm.ObjectFileRef.from_data(machine.emit_object(module))
        module.close()  # it takes three times the memory of its code
        self.engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self.engine.add_object_file(code)
        self.engine.finalize_object()
        self.run: Function = SIGNATURE(self.engine.get_function_address("run"))


def choose_hasty_width(width: int) -> int:
    """Return how many runs a vector has in quickly made code (LLVM's level 0): as many as fit one register here.

    `width` runs fit one register of AVX-512, and half of them one of other processors. LLVM can split a longer vector,
    but then takes three times as long to make code of selections and comparisons. Optimised code uses `width` anyhow.
    """
    return width if "+avx512f" in find_processor_features()[1].split(",") else width // 2


@cache
def get_careful_thread() -> ThreadPoolExecutor:
    """Return the executor with the one thread that generates optimised code, while calls execute the first code.

    All programs share it, so that optimised code is generated for one program after another.
    """
    return ThreadPoolExecutor(1)


@cache
def _get_waiting_thread() -> ThreadPoolExecutor:
    """Return the executor with the one thread that generates code for which the main thread waits."""
    return ThreadPoolExecutor(1)


@turn_failures_into_refusals("a program")
def emit_code(source: FunctionSource, level: int, width: int) -> MachineCode:
    """Return machine code for vectors of `width` runs, made at LLVM's `level`: 0 quickly made, 1 optimised.

    The code is never generated in the main thread. There Python may raise a signal's exception between any two
    operations. An LLVM object that is just changing its owner would then be freed twice.

    Raises:
        Unsupported: LLVM makes no code. A warning says so once.
    """
    if current_thread() is not main_thread():
        return MachineCode(source, level, width)
    return _get_waiting_thread().submit(MachineCode, source, level, width).result()


def _generate_optimised(source: FunctionSource, width: int, quick: MachineCode) -> MachineCode:
    """Return optimised code (LLVM's level 1) of a source; if this fails, warn once and return `quick`.

    `quick` is the code of this source that was quickly made (level 0).
    """
    try:
        return MachineCode(source, 1, width)
    except Exception as error:
        warn_once(
            f"native code: generated with care it failed ({type(error).__name__}: {error}); that in haste goes on"
        )
        return quick


class TieredCode:
    """Machine code of one source: quickly made code first, and optimised code once it is executed often enough.

    A call that executes the program at least OFTEN times waits for the optimised code. Any other call executes the
    quickly made code until the optimised code is done in the background. Both have the same results, bit for bit, so
    that nothing but time depends on earlier calls.
    """

    def __init__(self, source: FunctionSource, widths: tuple[int, int]):
        """Begin without machine code.

        `widths`: how many runs a vector has in quickly made code, and in optimised code.
        """
        self._source, self._widths = source, widths
        self._executions, self._lock = 0.0, Lock()  # how often each operation was executed so far, on average
        self._machine: MachineCode | None = None  # the code that calls execute at present
        self._optimised: Future[MachineCode] | None = None  # the optimised code that a thread is making, or has made

    def generate_code(self, blocks: float) -> None:
        """Generate machine code, if there is none yet, for a first call that computes so many blocks of runs."""
        with self._lock:
            self._make_first(self._executions + self._count_executions(blocks))

    def choose_machine(self, blocks: float) -> MachineCode:
        """Return the code that a call is to execute for so many blocks, and count these executions.

        A block is as many runs as a vector of optimised code has. The caller holds the code while it runs, since this
        object may replace it.
        """
        machine = self._machine
        if machine is not None and machine.level:  # optimised already
            return machine
        with self._lock:
            executions = self._count_executions(blocks)
            self._executions += executions
            machine = self._make_first(self._executions)
            # `_choose_level` comes last, since JAX takes 30 us to say its setting.
            if not machine.level and self._choose_level(self._executions):
                width = self._widths[1]  # of optimised code
                self._optimised = self._optimised or get_careful_thread().submit(
                    _generate_optimised, self._source, width, machine
                )
                # A long call waits for the optimised code. Others do not.
                if executions >= OFTEN or self._optimised.done():
                    self._machine = machine = self._optimised.result()
            return machine

    def _make_first(self, executions: float) -> MachineCode:
        """Return the first machine code, and make it if this is the first call.

        `executions`, how often the code will run, decides whether it is quickly made (level 0) or optimised (1).
        """
        if self._machine is None:
            level = self._choose_level(executions)
            self._machine = emit_code(self._source, level, self._widths[level])
        return self._machine

    def _count_executions(self, blocks: float) -> float:
        """Return how often each operation is executed, on average, for so many blocks; in a loop once an iteration."""
        return blocks * self._source.work / max(self._source.operations, 1)

    def _choose_level(self, executions: float) -> int:
        """Return LLVM's level: 1 (optimised) if it pays for so many executions and JAX's setting allows it, else 0."""
        pays = executions >= OFTEN
        return int(pays and not jax.config.values["jax_disable_most_optimizations"])
