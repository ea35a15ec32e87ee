"""Memory of numbers that all runs share, between the function that computes them and the one that uses them."""

from typing import Protocol

from straightline.llvm.operations import LLVM, vector_type
from straightline.nodes import Block, Node


class InstructionWriter(Protocol):
    """What appends LLVM instructions to the function that is being written."""

    def add(self, text: str) -> str:
        """Append an instruction, given without its result as in "add i64 %a, 1"; return the new name of its result."""

    def line(self, text: str) -> None:
        """Append an instruction without a result, such as a store or a jump."""

    def write_scalar(self, node: Node) -> str:
        """Return the LLVM name of a number that all runs share, such as a loop's counter, as a scalar."""


def write_address_in_iteration(writer: InstructionWriter, start: str, block: Block, size: int) -> str:
    """Write the address, in memory from `start` on, of the `size` bytes for the current iteration; return its name.

    Memory has such bytes for each iteration of the loops around `block`. With their counters c_1, c_2, ... and lengths
    n_1, n_2, ..., the innermost loop first, the address is start + size (c_1 + n_1 (c_2 + n_2 (c_3 + ...))).
    """
    offset, stride = "", size
    for loop in block.list_loops():
        assert loop.counter is not None
        step = writer.add(f"mul i64 {writer.write_scalar(loop.counter)}, {stride}")
        offset = writer.add(f"add i64 {offset}, {step}") if offset else step
        stride *= loop.length or 1
    return writer.add(f"getelementptr i8, ptr {start}, i64 {offset}") if offset else start


class SharedSlots:
    """Memory of numbers that all runs share: the function of shared numbers stores them, the block function loads them.

    A number that a loop computes has a slot for each of its iterations.
    """

    def __init__(self, size: int):
        """Begin without slots; the next one begins at byte `size` of the memory that all runs share."""
        self.size = size  # bytes that are taken so far
        self.offsets: dict[Node, int] = {}  # the first byte of each number
        self.base = ""  # name of the pointer to the memory, in LLVM's text

    def offset_of(self, node: Node) -> int:
        """Return the offset in bytes of a shared number's slot, assigned at its first use.

        A slot has 8 bytes for each iteration of the loops around the number.
        """
        if node not in self.offsets:
            self.offsets[node] = self.size
            self.size += 8 * node.block.count_iterations()
        return self.offsets[node]

    def load(self, writer: InstructionWriter, node: Node) -> str:
        """Write the load of a shared number from its slot, and return the name of the scalar.

        A boolean is stored as a byte, of which the lowest bit counts.
        """
        address = self._write_address(writer, node)
        if node.type == "bool":
            return writer.add(f"trunc i8 {writer.add(f'load i8, ptr {address}, align 8')} to i1")
        return writer.add(f"load {LLVM[node.type]}, ptr {address}, align 8")

    def store(self, writer: InstructionWriter, node: Node, name: str) -> None:
        """Write the store of a shared number, whose LLVM name is `name`, to its slot; a boolean is stored as a byte.

        The block function, which computes what differs between runs, loads it from there.
        """
        kind = vector_type(node.type)
        address = self._write_address(writer, node)
        if node.type == "bool":
            name, kind = writer.add(f"zext {kind} {name} to %i8"), "%i8"
        writer.line(f"store {kind} {name}, ptr {address}, align 1")

    def _write_address(self, writer: InstructionWriter, node: Node) -> str:
        """Write the address of a number's slot of 8 bytes in the current iteration of its loops; return its name."""
        start = writer.add(f"getelementptr i8, ptr {self.base}, i64 {self.offset_of(node)}")
        return write_address_in_iteration(writer, start, node.block, size=8)
