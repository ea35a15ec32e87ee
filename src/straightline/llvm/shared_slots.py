"""Memory of numbers that all runs share, between the function that computes them and the one that uses them."""

from typing import Protocol

from straightline.llvm.operations import LLVM, vector_type
from straightline.nodes import Block, Node


class InstructionWriter(Protocol):
    """What appends LLVM instructions to the function that is being written."""

    def add(self, text: str) -> str:
        """Append an operation in LLVM's text; return the new name of its result."""

    def line(self, text: str) -> None:
        """Append a line without a result."""

    def write_address_in_iteration(self, start: str, block: Block, size: int) -> str:
        """Write the address of a number of `size` bytes in the current iteration of the loops around its block.

        `start` is the name of the address in the first iteration.
        """


class SharedSlots:
    """Memory of numbers that all runs share: the function of shared numbers stores them, the block function loads them.

    A number that a loop computes has a slot for each of its iterations.
    """

    def __init__(self, size: int):
        """Begin the layout at byte `size` of the shared memory: the bytes before it are taken already."""
        self.size = size  # bytes that are taken so far
        self.offsets: dict[Node, int] = {}  # the first byte of each number
        self.base = ""  # name of the pointer to the memory, in LLVM's text

    def offset_of(self, node: Node) -> int:
        """Return the offset in bytes of a shared number, assigned at its first use, with 8 for each iteration."""
        if node not in self.offsets:
            self.offsets[node] = self.size
            self.size += 8 * node.block.count_iterations()
        return self.offsets[node]

    def load(self, writer: InstructionWriter, node: Node) -> str:
        """Write the load of a shared number, and return the name of the scalar; a flag is stored as a byte."""
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
        return writer.write_address_in_iteration(start, node.block, size=8)
