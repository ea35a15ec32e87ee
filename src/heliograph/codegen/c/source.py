"""Graphs as statements of C99: a local variable for each number, loops and guarded blocks as in the graph."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from heliograph.codegen.c.operations import Real, c_type, expression, literal
from heliograph.codegen.graph import Block, Buffer, Check, Guard, Loop, Node, Store
from heliograph.codegen.program import needed

WIDTH = 100  # characters of a line of a table
Place = Callable[[str], str]  # from an index to what stands there


class CSource:
    """Statements that compute some nodes, and the tables that they read.

    `places`: expressions of the numbers of each input. `prefix`: prefix of the names of tables.
    """

    def __init__(self, roots: Iterable[Node], places: Mapping[Buffer, Place], real: Real, prefix: str):
        self.places, self.real, self.prefix = places, real, prefix
        self.needed = needed(roots)
        self.names: dict[Node, str] = {}
        self.arrays: dict[Buffer, str] = {}
        self.tables: dict[tuple[str, bytes], tuple[str, str]] = {}
        self.operations: dict[str, int] = {}
        self.count = 0

    def name(self, node: Node) -> str:
        """Return the variable or literal of a number."""
        return literal(node.value, node.type, self.real) if node.op == "constant" else self.names[node]

    def statements(self, block: Block, indent: str = "    ") -> list[str]:
        """Return a block's statements, in order."""
        lines: list[str] = []
        for item in block.items:
            # Only what is needed; the end of a loop always is.
            if item not in self.needed and not isinstance(item, Check):
                continue
            if isinstance(item, Node):
                lines += self._node(item, indent)
            elif isinstance(item, Loop):
                lines += self._loop(item, indent)
            elif isinstance(item, Guard):
                lines += self._guard(item, indent)
            elif isinstance(item, Store):
                entry = self._entry(item.buffer, item.offset, item.strides, item.indices)
                lines.append(f"{indent}{entry} = {self.name(item.node)};")
            else:
                condition = item.loop.condition
                assert condition is not None  # only a loop that ends by its condition has a check
                lines.append(f"{indent}if (!{self.name(condition)}) break;")
        return lines

    def declarations(self, indent: str = "    ") -> list[str]:
        """Declare the arrays that the statements fill."""
        arrays = self.arrays.items()
        return [f"{indent}{c_type(b.type, self.real)} {name}[{max(b.size, 1)}];" for b, name in arrays]

    def table_definitions(self) -> list[str]:
        """Define the tables, one definition each."""
        return [text for _, text in self.tables.values()]

    def _new(self) -> str:
        self.count += 1
        return f"v{self.count}"

    def _node(self, node: Node, indent: str) -> list[str]:
        if node.op in ("constant", "counter", "parameter", "result", "guarded"):
            return []
        if node.op == "load":
            text = self._load(node)
        else:
            text = expression(node, [self.name(a) for a in node.args], self.real)
            self.operations[node.op] = self.operations.get(node.op, 0) + 1
        self.names[node] = self._new()
        return [f"{indent}const {c_type(node.type, self.real)} {self.names[node]} = {text};"]

    def _load(self, node: Node) -> str:
        buffer, offset, strides = node.value
        return self._entry(buffer, offset, strides, node.args)

    def _entry(self, buffer: Buffer, offset: int, strides: Sequence[int], indices: Sequence[Node]) -> str:
        """Return the expression of a number in memory, which may be part of another array."""
        whole, start = buffer.owner
        index = self._at(start + offset, strides, indices)
        if whole.table is not None:
            return f"{self._table(whole)}[{index}]"
        if whole in self.places:
            return self.places[whole](index)
        return f"{self.arrays.setdefault(whole, f'a{len(self.arrays)}')}[{index}]"

    def _at(self, offset: int, strides: Sequence[int], indices: Sequence[Node]) -> str:
        terms = [f"{s} * {self.name(i)}" if s != 1 else self.name(i) for s, i in zip(strides, indices, strict=True)]
        return " + ".join(([str(offset)] if offset or not terms else []) + terms)

    def _table(self, buffer: Buffer) -> str:
        assert buffer.table is not None
        values: np.ndarray = np.ascontiguousarray(buffer.table)
        key = (buffer.type, values.tobytes())
        if key not in self.tables:
            name = f"{self.prefix}_table_{len(self.tables)}"
            numbers = [literal(x, buffer.type, self.real) for x in values.ravel().tolist()]
            head = f"static const {c_type(buffer.type, self.real)} {name}[{len(numbers)}] = {{"
            self.tables[key] = name, "\n".join([head, *_wrapped(numbers), "};"])
        return self.tables[key][0]

    def _loop(self, loop: Loop, indent: str) -> list[str]:
        """Write a loop, with variables that carry numbers from turn to turn."""
        deeper, lines = f"{indent}    ", []
        carried = [p for p, node in enumerate(loop.parameters) if {node, loop.results[p]} & self.needed]
        for place in carried:
            name, start = self._new(), loop.initial[place]
            lines.append(f"{indent}{c_type(start.type, self.real)} {name} = {self.name(start)};")
            self.names[loop.parameters[place]] = self.names[loop.results[place]] = name
        head = "for (;;) {"
        if loop.length is not None:
            counter = self._new()
            if loop.counter is not None:
                self.names[loop.counter] = counter
            head = f"for (int64_t {counter} = 0; {counter} < {loop.length}; ++{counter}) {{"
        lines += [f"{indent}{head}", *self.statements(loop.body, deeper)]
        # What follows may be another parameter, which must not have changed yet.
        ends: list[str] = []
        for place in carried:
            node = loop.following[place]
            ends.append(self.name(node))
            if node.op == "parameter":
                ends[-1] = self._new()
                lines.append(f"{deeper}const {c_type(node.type, self.real)} {ends[-1]} = {self.name(node)};")
        lines += [f"{deeper}{self.names[loop.parameters[p]]} = {end};" for p, end in zip(carried, ends, strict=True)]
        return [*lines, f"{indent}}}"]

    def _guard(self, guard: Guard, indent: str) -> list[str]:
        """Write a guarded block; its results are zero if the condition does not hold."""
        results = [(r, v) for r, v in zip(guard.results, guard.values, strict=True) if r in self.needed]
        lines = []
        for result, _ in results:
            self.names[result] = self._new()
            lines.append(f"{indent}{c_type(result.type, self.real)} {self.names[result]} = 0;")
        deeper = f"{indent}    "
        lines += [f"{indent}if ({self.name(guard.condition)}) {{", *self.statements(guard.body, deeper)]
        return [*lines, *(f"{deeper}{self.names[r]} = {self.name(v)};" for r, v in results), f"{indent}}}"]


def _wrapped(numbers: Sequence[str]) -> list[str]:
    lines, line = [], "   "
    for number in numbers:
        if len(line) + len(number) + 2 > WIDTH:
            lines.append(line)
            line = "   "
        line += f" {number},"
    return [*lines, line]
