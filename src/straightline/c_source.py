"""Graphs as statements of C99: a local variable for each number; operations, loops and guards as in the graph."""

import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal

import numpy as np

from straightline.nodes import REAL, Block, Buffer, Guard, Loop, LoopExit, Node, Store, Type, Unsupported
from straightline.program import list_needed_items

Real = Literal["double", "float"]

INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|", "xor": "^"}
ORDER = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
# Orders of floating-point numbers: operators would raise a flag at NaN, which is a component that did not arrive.
QUIET = {"lt": "isless", "le": "islessequal", "gt": "isgreater", "ge": "isgreaterequal"}
# Functions of libm by the operation's name; in single precision they end in f.
FUNCTIONS = {name: name for name in (
    "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan2", "pow", "floor", "ceil", "asin",
    "acos", "atan", "sinh", "cosh", "asinh", "acosh", "atanh", "cbrt", "exp2", "erf", "erfc", "lgamma",
)} | {"abs": "fabs", "rem": "fmod", "round_even": "nearbyint", "round_away": "round"}  # fmt: skip
# What is more than one operator or function; arguments are names or literals, never expressions.
COMPOSED: dict[str, Callable[..., str]] = {
    "neg": "-{0}".format,
    "max": "((isgreater({0}, {1}) || ({0} != {0}) || (({0} == {1}) && !signbit({0}))) ? {0} : {1})".format,
    "min": "((isless({0}, {1}) || ({0} != {0}) || (({0} == {1}) && signbit({0}))) ? {0} : {1})".format,
    "sign": "(isgreater({0}, 0) ? 1 : (isless({0}, 0) ? -1 : {0}))".format,
    "is_finite": "!!isfinite({0})".format,
}
# Operations on integers, of b bits: {t} the type, {u} that without a sign. What C leaves undefined is JAX's: numbers
# wrap around, a division by zero has all bits, a shift by all bits leaves nothing or the sign.
WHOLE: dict[str, Callable[..., str]] = {
    "add": "({t})(({u}){0} + ({u}){1})".format,
    "sub": "({t})(({u}){0} - ({u}){1})".format,
    "mul": "({t})(({u}){0} * ({u}){1})".format,
    "neg": "({t})(0 - ({u}){0})".format,
    "abs": "({0} < 0 ? ({t})(0 - ({u}){0}) : {0})".format,
    "sign": "(({0} > 0) - ({0} < 0))".format,
    "max": "({0} > {1} ? {0} : {1})".format,
    "min": "({0} < {1} ? {0} : {1})".format,
    "div": "({1} == 0 ? -1 : {1} == -1 ? ({t})(0 - ({u}){0}) : {0} / {1})".format,
    "rem": "({1} == 0 ? {0} : {1} == -1 ? 0 : {0} % {1})".format,
    "shift_left": "(({u}){1} < {b} ? ({t})(({u}){0} << {1}) : 0)".format,
    "shift_right": "(({u}){1} < {b} ? ({t})(({u}){0} >> {1}) : 0)".format,
    "shift_right_signed": "({t})(({s}){0} < 0 ? ~(~({s}){0} >> {by}) : ({s}){0} >> {by})".format,
}
UNSIGNED: dict[str, Callable[..., str]] = {
    "div": "({1} ? {0} / {1} : ({t})-1)".format,
    "rem": "({1} ? {0} % {1} : {0})".format,
    "abs": "{0}".format,
    "sign": "({0} != 0)".format,
}


def c_type(type: Type, real: Real) -> str:
    """Return the C type of a number of this type in the program, such as int32_t for "i32"; a flag is an int.

    `real` is the C type in which numbers of double precision are computed: "double" or "float".
    """
    if type in REAL:
        return real if type == "f64" else "float"
    return {"bool": "int", "i32": "int32_t", "i64": "int64_t", "u32": "uint32_t", "u64": "uint64_t"}[type]


def write_literal(value: float | int | bool, type: Type, real: Real) -> str:
    """Return a known number as a literal of C with every digit that its type has.

    Args:
        value: the number.
        type: its type in the graph.
        real: the type of C for numbers that are f64 in the graph.

    Raises:
        ValueError: a number beyond the range of single precision.
    """
    if type == "bool":
        return "1" if value else "0"
    if type not in REAL:
        is_unsigned, is_long = type.startswith("u"), type.endswith("64")
        suffix = f"{'U' if is_unsigned else ''}{'LL' if is_long else ''}"
        if value >= 0:
            return f"{int(value)}{suffix}"
        # -n as -(n - 1) - 1: in C, -2147483648 is the negative of a literal that is too large for its type.
        return f"({int(value) + 1}{suffix} - 1)"
    # Floating-point numbers: the shortest text that reads back as the same number.
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    if c_type(type, real) == "float":
        if abs(value) == sys.float_info.max:  # the largest number there is, as in nan_to_num
            value = math.copysign(float(np.finfo(np.float32).max), value)
        with np.errstate(over="ignore", under="ignore"):
            single = np.float32(value)
        if not np.isfinite(single):
            raise ValueError(f"single precision: expected numbers up to 3.4e38, got {value}")
        text = f"{single!s}f"
    else:
        text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


def write_expression(node: Node, arguments: Sequence[str], real: Real) -> str:
    """Return the C expression of a node's operation on arguments, which are names and literals.

    Operations that depend on the types are written first, then those of the tables by operation.

    Args:
        node: an operation of the program's graph, with its type and its arguments' types.
        arguments: C texts of its arguments.
        real: type of C for numbers that are f64 in the graph, "double" or "float".

    Raises:
        Unsupported: an operation that C does not have.
    """
    op, source = node.op, node.args[0].type
    if op == "select":
        return f"({arguments[0]} ? {arguments[1]} : {arguments[2]})"
    if op == "convert":
        return _write_conversion(source, node.type, arguments[0], real)
    if op == "bitcast":
        return _write_bitcast(source, node.type, arguments[0], real)
    if op == "not":
        return f"!{arguments[0]}" if source == "bool" else f"({c_type(source, real)})~{arguments[0]}"
    # Comparisons: of real numbers by the macros that raise no floating-point flag for NaN.
    if source in REAL and op in QUIET:
        return f"{QUIET[op]}({', '.join(arguments)})"
    if op in ORDER:
        return f"{arguments[0]} {ORDER[op]} {arguments[1]}"
    # Integers before the operators of all types, since C's operators on them leave undefined what JAX defines. Of flags
    # only the extremes are written as those of integers: the other operators have the same sense for them.
    if source == "bool" and op in ("max", "min"):
        return WHOLE[op](*arguments)
    if source not in (*REAL, "bool") and op in WHOLE:
        return _write_integer(op, source, arguments)
    # Real numbers, and flags: several operations of C, one operator, or a function of libm.
    if op in COMPOSED:
        return COMPOSED[op](*arguments)
    if op in INFIX:
        return f"{arguments[0]} {INFIX[op]} {arguments[1]}"
    if op in FUNCTIONS and source in REAL:
        suffix = "f" if c_type(source, real) == "float" else ""  # sinf is the sin of float
        return f"{FUNCTIONS[op]}{suffix}({', '.join(arguments)})"
    raise Unsupported(op)


def _write_integer(op: str, type: Type, arguments: Sequence[str]) -> str:
    """Return the C expression of an operation on integers, in a form that C defines for all arguments.

    C leaves signed overflow and long shifts undefined, so the operation is computed on unsigned numbers. WHOLE holds
    a template for each operation; UNSIGNED holds simpler ones for operations on unsigned types.
    """
    bits, is_unsigned = int(type[1:]), type[0] == "u"
    unsigned, signed = f"uint{bits}_t", f"int{bits}_t"
    if is_unsigned and op in UNSIGNED:
        return UNSIGNED[op](*arguments, t=unsigned)
    # A longer shift becomes one by bits - 1, which leaves only copies of the sign.
    shift = arguments[-1]
    in_range = f"{shift} < {bits}" if is_unsigned else f"{shift} >= 0 && {shift} < {bits}"
    limited_shift = f"(({in_range}) ? {shift} : {bits - 1})"
    own_type = unsigned if is_unsigned else signed
    return WHOLE[op](*arguments, t=own_type, u=unsigned, s=signed, b=bits, by=limited_shift)


def _write_conversion(source: Type, target: Type, name: str, real: Real) -> str:
    """Return the C expression of a number in another type.

    A real one as an integer is truncated, the type's limit where it is beyond, and 0 of NaN; as a flag it is != 0.
    """
    if target == "bool":
        return f"({name} != 0)"
    target_in_c = c_type(target, real)
    if source not in REAL or target in REAL:
        return f"({target_in_c}){name}"
    # A real number x as an integer of b bits: the greatest integer for x >= end, the least for x <= low_end. The end is
    # 2^(b - 1), or without a sign 2^b; the least integer is -end, which is in range itself, or 0.
    bits, is_signed = int(target[1:]), target[0] == "i"
    limits = target_in_c.removesuffix("_t").upper()  # int32_t -> INT32, of the macros INT32_MIN and INT32_MAX
    suffix = "f" if c_type(source, real) == "float" else ""
    end = f"{2.0 ** (bits - is_signed):.1f}{suffix}"
    least, low_end = (f"{limits}_MIN", f"-{end}") if is_signed else ("0", "0")
    too_low = f"islessequal({name}, {low_end})"
    in_range = f"{name} == {name} ? ({target_in_c}){name} : 0"  # NaN does not equal itself
    return f"(isgreaterequal({name}, {end}) ? {limits}_MAX : {too_low} ? {least} : {in_range})"


def _write_bitcast(source: Type, target: Type, name: str, real: Real) -> str:
    """Return the C expression that reads the bits of the variable `name` as another type, through a union.

    Two integer types need only a cast. `real` is the C type in which reals are computed. In the union an f64 is a C
    double even if `real` is float, since the bits that are read are those of its own width.
    """
    if not {source, target} & REAL:
        return f"({c_type(target, real)}){name}"
    fields = " ".join(f"{c_type(t, 'double')} {t};" for t in (source, target))
    return f"({c_type(target, real)})((union {{ {fields} }}){{ .{source} = {name} }}).{target}"


WIDTH = 100  # characters of a line of a table
EntryText = Callable[[str], str]  # from an index to what stands there


class CSource:
    """Writer of the C statements that compute some nodes (scalar operations), and of the tables that they read."""

    def __init__(self, roots: Iterable[Node], entry_texts: Mapping[Buffer, EntryText], real: Real, prefix: str):
        """Begin a source without statements.

        `roots` are the nodes to compute. `entry_texts` maps each argument's or result's buffer to a function that
        returns the C text of its entry at an index. `real` is the C type of reals, and `prefix` begins the tables'
        names.
        """
        self.entry_texts, self.real, self.prefix = entry_texts, real, prefix
        self.needed = list_needed_items(roots)
        self.names: dict[Node, str] = {}  # variable of each node that is computed
        self.arrays: dict[Buffer, str] = {}  # local array of each buffer that is filled
        self.tables: dict[tuple[str, bytes], tuple[str, str]] = {}  # name and definition, by type and numbers
        self.operations: dict[str, int] = {}  # how often each operation was written
        self.count = 0  # how many variables there are

    def name_node(self, node: Node) -> str:
        """Return the C text of a node's number: a literal if it is known, else the variable that holds it."""
        return write_literal(node.value, node.type, self.real) if node.op == "constant" else self.names[node]

    def _clip_to_range(self, node: Node) -> str:
        """Return the text of a number that others are compared with; in float, a constant is clipped to float's range.

        A constant beyond that range bounds no float, and `write_literal` would refuse it. One that is nearer to zero
        than any normal float, such as the least double, asks whether there is a reciprocal, and would be zero.
        """
        if node.op != "constant" or self.real != "float" or node.type != "f64" or not math.isfinite(node.value):
            return self.name_node(node)
        limits = np.finfo(np.float32)
        size = min(max(abs(node.value), float(limits.tiny)), float(limits.max)) if node.value else 0.0
        return write_literal(math.copysign(size, node.value), node.type, self.real)

    def write_statements(self, block: Block, indent: str = "    ") -> list[str]:
        """Return the lines of C for a block's operations and statements, in order, each after `indent`."""
        lines: list[str] = []
        for statement in block.items:
            # Only what the results need; the exit of a loop is in no list of needs.
            if statement not in self.needed and not isinstance(statement, LoopExit):
                continue
            if isinstance(statement, Node):
                lines += self._write_node(statement, indent)
            elif isinstance(statement, Loop):
                lines += self._write_loop(statement, indent)
            elif isinstance(statement, Guard):
                lines += self._write_guard(statement, indent)
            elif isinstance(statement, Store):
                entry = self._write_entry(statement.buffer, statement.offset, statement.strides, statement.indices)
                lines.append(f"{indent}{entry} = {self.name_node(statement.node)};")
            else:
                condition = statement.loop.condition
                assert condition is not None  # only a loop that ends by its condition has a check
                lines.append(f"{indent}if (!{self.name_node(condition)}) break;")
        return lines

    def declarations(self, indent: str = "    ") -> list[str]:
        """Return the declarations, in C, of the local arrays that the statements fill."""
        arrays = self.arrays.items()
        return [f"{indent}{c_type(b.type, self.real)} {name}[{max(b.size, 1)}];" for b, name in arrays]

    def table_definitions(self) -> list[str]:
        """Return the definitions, in C, of the constant arrays (tables) that the statements read."""
        return [text for _, text in self.tables.values()]

    def _new_name(self) -> str:
        """Return the name of a new variable of C: v1, v2, ..."""
        self.count += 1
        return f"v{self.count}"

    def _write_node(self, node: Node, indent: str) -> list[str]:
        """Return the line of C that computes a node into a new variable, as a list of one.

        The list is empty for a constant, and for a node that a loop or a guard has named already.
        """
        if node.op in ("constant", "counter", "parameter", "result", "guarded"):
            return []
        if node.op == "load":
            buffer, offset, strides = node.value
            text = self._write_entry(buffer, offset, strides, node.args)
        else:
            named = self._clip_to_range if node.op in ("min", "max", *QUIET) else self.name_node
            text = write_expression(node, [named(a) for a in node.args], self.real)
            self.operations[node.op] = self.operations.get(node.op, 0) + 1
        self.names[node] = self._new_name()
        return [f"{indent}const {c_type(node.type, self.real)} {self.names[node]} = {text};"]

    def _write_entry(self, buffer: Buffer, offset: int, strides: Sequence[int], indices: Sequence[Node]) -> str:
        """Return the expression of buffer[offset + sum strides * indices] in C.

        `buffer.owner` is (whole, start): the buffer is the part of a larger one, `whole`, that begins at `start`.
        `whole` is a table of constants, an argument or result (`entry_texts` writes its entries), or a local array.
        """
        whole, start = buffer.owner
        index = self._write_index(start + offset, strides, indices)
        if whole.table is not None:
            return f"{self._name_table(whole)}[{index}]"
        if whole in self.entry_texts:
            return self.entry_texts[whole](index)
        return f"{self.arrays.setdefault(whole, f'a{len(self.arrays)}')}[{index}]"

    def _write_index(self, offset: int, strides: Sequence[int], indices: Sequence[Node]) -> str:
        """Return the C expression offset + sum strides * indices, without factors of 1 and without a zero offset."""
        terms = [
            f"{s} * {self.name_node(i)}" if s != 1 else self.name_node(i) for s, i in zip(strides, indices, strict=True)
        ]
        return " + ".join(([str(offset)] if offset or not terms else []) + terms)

    def _name_table(self, buffer: Buffer) -> str:
        """Return the name of the C constant array that holds a table's numbers; equal tables share one."""
        assert buffer.table is not None
        values: np.ndarray = np.ascontiguousarray(buffer.table)
        key = (buffer.type, values.tobytes())
        if key not in self.tables:
            name = f"{self.prefix}_table_{len(self.tables)}"
            numbers = [write_literal(x, buffer.type, self.real) for x in values.ravel().tolist()]
            head = f"static const {c_type(buffer.type, self.real)} {name}[{len(numbers)}] = {{"
            self.tables[key] = name, "\n".join([head, *_wrap_numbers(numbers), "};"])
        return self.tables[key][0]

    def _write_loop(self, loop: Loop, indent: str) -> list[str]:
        """Return the lines of a loop: a variable for each carried number that is read, the body, and new values.

        The loop is one of a computation graph: in each iteration its body maps carried numbers (`parameters`, which
        start at `initial`) to their next values (`following`); after the loop they are its `results`. A loop without a
        length has in its body the `break` that ends it.
        """
        deeper, lines = f"{indent}    ", []
        # Indices of the carried numbers that are read. Each becomes one C variable, declared with the initial number.
        # It stands for the parameter within the loop, and for the result after it.
        carried = [k for k, node in enumerate(loop.parameters) if {node, loop.results[k]} & self.needed.keys()]
        for k in carried:
            name, start = self._new_name(), loop.initial[k]
            lines.append(f"{indent}{c_type(start.type, self.real)} {name} = {self.name_node(start)};")
            self.names[loop.parameters[k]] = self.names[loop.results[k]] = name
        # Head and body of the loop.
        lines += [f"{indent}{self._write_loop_head(loop)}", *self.write_statements(loop.body, deeper)]
        # The values of the next iteration are assigned at the end, all at once. A value that is itself a carried
        # variable is copied first, since the assignments change that variable.
        next_values: list[str] = []
        for k in carried:
            node = loop.following[k]
            value = self.name_node(node)
            if node.op == "parameter":  # of this loop or of one around it
                value = self._new_name()
                lines.append(f"{deeper}const {c_type(node.type, self.real)} {value} = {self.name_node(node)};")
            next_values.append(value)
        for k, value in zip(carried, next_values, strict=True):
            lines.append(f"{deeper}{self.names[loop.parameters[k]]} = {value};")
        return [*lines, f"{indent}}}"]

    def _write_loop_head(self, loop: Loop) -> str:
        """Return the head of a C loop, and note the name of the counter's node.

        A loop of known length counts its iterations. One of unknown length (None) is endless, and a check within it
        ends it.
        """
        if loop.length is None:
            return "for (;;) {"
        counter = self._new_name()
        if loop.counter is not None:
            self.names[loop.counter] = counter
        return f"for (int64_t {counter} = 0; {counter} < {loop.length}; ++{counter}) {{"

    def _write_guard(self, guard: Guard, indent: str) -> list[str]:
        """Return the lines of a guarded block: an `if` whose results are zero where the condition does not hold.

        Each result's variable is declared as 0 before the `if`, and gets its value at the block's end. Results that
        the C function does not need (`self.needed` holds those that it needs) are left out.
        """
        pairs = [(result, value) for result, value in zip(guard.results, guard.values, strict=True)
                 if result in self.needed]  # fmt: skip
        lines = []
        for result, _ in pairs:
            self.names[result] = self._new_name()
            lines.append(f"{indent}{c_type(result.type, self.real)} {self.names[result]} = 0;")
        inner = f"{indent}    "
        lines += [f"{indent}if ({self.name_node(guard.condition)}) {{", *self.write_statements(guard.body, inner)]
        lines += [f"{inner}{self.names[result]} = {self.name_node(value)};" for result, value in pairs]
        return [*lines, f"{indent}}}"]


def _wrap_numbers(numbers: Sequence[str]) -> list[str]:
    """Return the texts of numbers as lines of C: each followed by a comma, at most WIDTH characters a line."""
    lines, line = [], "   "
    for number in numbers:
        if len(line) + len(number) + 2 > WIDTH:
            lines.append(line)
            line = "   "
        line += f" {number},"
    return [*lines, line]
