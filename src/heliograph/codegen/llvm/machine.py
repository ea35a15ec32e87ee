"""Compilation of LLVM IR to code of this machine."""

import ctypes
from collections.abc import Callable
from functools import cache

import jax
import llvmlite.binding as llvm

Function = Callable[[int, int, int, int, int], None]
SIGNATURE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)


@cache
def target() -> llvm.Target:
    """Return the LLVM target of this machine."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple()


@cache
def features() -> tuple[str, str, bool]:
    """Return this processor's name and features for LLVM, and whether it has fused multiply-add."""
    result = llvm.get_host_cpu_features()
    arm = "aarch64" in target().triple or "arm64" in target().triple
    return llvm.get_host_cpu_name(), result.flatten(), bool(result.get("fma")) or arm


class Machine:
    """Code of one text; its function `run` may be called as long as this object exists.

    LLVM's optimisation passes find nothing more in straight lines, and would take as long as the generation of code.
    """

    def __init__(self, text: str):
        level = 0 if jax.config.values["jax_disable_most_optimizations"] else 1
        cpu, flags, *_ = features()
        machine = target().create_target_machine(cpu=cpu, features=flags, opt=level)
        module = llvm.parse_assembly(text)
        module.verify()
        self.engine = llvm.create_mcjit_compiler(module, machine)
        self.engine.finalize_object()
        self.run: Function = SIGNATURE(self.engine.get_function_address("run"))
