"""Functions of vectors, compiled and called on arrays."""

import ctypes
from collections.abc import Iterable

import llvmlite.binding as llvm
import numpy as np

from straightline.llvm.vector_types_and_gathers import write_vector_types
from straightline.vectors.elementary_functions import write_elementary_functions

WIDTH = 8


class Compiled:
    """The functions of these names on vectors of 8 numbers, doubles or floats; a call takes and gives arrays."""

    def __init__(self, names: Iterable[str], single: bool = False):
        self.single = single
        names = [f"{name}f" if single else name for name in names]
        self.engine = engine_of(
            write_elementary_functions(names, WIDTH) + "".join(_loop(name, single) for name in names)
        )

    def __call__(self, name: str, *arguments: np.ndarray) -> np.ndarray:
        """The function's results."""
        count = len(arguments[0])
        dtype, ending = (np.float32, "f") if self.single else (np.float64, "")
        both = (*arguments, arguments[-1])[:2]
        filled = [np.concatenate([a, np.ones(-count % WIDTH)]).astype(dtype) for a in both]
        result = np.empty_like(filled[0])
        pointers = [a.ctypes.data for a in (*filled, result)]
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_int64)
        kind(self.engine.get_function_address(f"loop_{name}{ending}"))(*pointers, len(result) // WIDTH)
        return result[:count]


def engine_of(text: str) -> llvm.ExecutionEngine:
    """Compiled code of the text of functions."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=1
    )
    module = llvm.parse_assembly(write_vector_types(WIDTH) + text)
    module.verify()
    engine = llvm.create_mcjit_compiler(module, target)
    engine.finalize_object()
    return engine


def _loop(name: str, single: bool) -> str:
    vector = "%float" if single else "%double"
    arguments = f"{vector} %a" + (f", {vector} %b" if name.removesuffix("f") in ("atan2", "pow") else "")
    return f"""
define void @loop_{name}(ptr %x, ptr %y, ptr %z, i64 %count) {{
entry:
  br label %loop
loop:
  %t = phi i64 [0, %entry], [%next, %loop]
  %p = getelementptr {vector}, ptr %x, i64 %t
  %q = getelementptr {vector}, ptr %y, i64 %t
  %s = getelementptr {vector}, ptr %z, i64 %t
  %a = load {vector}, ptr %p, align 4
  %b = load {vector}, ptr %q, align 4
  %r = call {vector} @hg_{name}({arguments})
  store {vector} %r, ptr %s, align 4
  %next = add i64 %t, 1
  %more = icmp slt i64 %next, %count
  br i1 %more, label %loop, label %end
end:
  ret void
}}
"""
