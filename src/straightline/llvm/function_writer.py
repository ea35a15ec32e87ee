"""Programs as text of LLVM IR: one function for blocks of W runs, and one for what all runs share.

What the second computes is in memory between them, in `SharedSlots`.
"""

from collections.abc import Collection, Sequence
from typing import Any

from straightline.llvm.operations import (
    BITS,
    CALLED,
    LLVM,
    name_called_function,
    vector_type,
    write_fused,
    write_operation,
    write_splat,
)
from straightline.llvm.prefetch import PrefetchedRows, write_prefetch_requests
from straightline.llvm.vector_types_and_gathers import WIDTH, gather_name
from straightline.nodes import REAL, Block, Buffer, Guard, Loop, LoopExit, Node, Store, Type
from straightline.program import find_fused_product
from straightline.size_limits import ANY_LENGTH, LONGEST_BASIC_BLOCK

Scope = dict[Any, str]


class SharedSlots:
    """Layout of numbers that all runs share, which one function computes and the other reads; all turns of a loop's."""

    def __init__(self, size: int):
        """Begin the layout at byte `size` of the shared memory: the bytes before it are taken already."""
        self.size = size  # bytes that are taken so far
        self.places: dict[Node, int] = {}  # the first byte of each number
        self.base = ""  # name of the pointer to the memory, in LLVM's text

    def offset_of(self, node: Node) -> int:
        """Return the offset of a shared number in bytes, assigned at its first use; each turn of its loops takes 8."""
        if node not in self.places:
            self.places[node] = self.size
            self.size += 8 * node.block.count_turns()
        return self.places[node]

    def load(self, writer: "FunctionWriter", node: Node) -> str:
        """Write the load of a shared number, and return the name of the scalar; a flag is stored as a byte."""
        address = self._write_address(writer, node)
        if node.type == "bool":
            return writer.add(f"trunc i8 {writer.add(f'load i8, ptr {address}, align 8')} to i1")
        return writer.add(f"load {LLVM[node.type]}, ptr {address}, align 8")

    def store(self, writer: "FunctionWriter", node: Node, name: str) -> None:
        """Write the store of a shared number, named `name`, for the function of blocks to load; a flag is a byte."""
        kind = vector_type(node.type)
        address = self._write_address(writer, node)
        if node.type == "bool":
            name, kind = writer.add(f"zext {kind} {name} to %i8"), "%i8"
        writer.line(f"store {kind} {name}, ptr {address}, align 1")

    def _write_address(self, writer: "FunctionWriter", node: Node) -> str:
        start = writer.add(f"getelementptr i8, ptr {self.base}, i64 {self.offset_of(node)}")
        return writer.write_address_of_turn(start, node.block, 8)


class FunctionWriter:
    """Writer of one of a program's two functions: of those of its operations that are in the set `mine`.

    Args:
        single: whether vectors are of one number, as in the function of what all runs share.
        mine: the items that this function computes: those that differ between runs, or those that do not.
        products: products that are fused with the sum that uses them.
        spread: the buffers with a number for each lane.
        slots: places of numbers that all runs share and that the other function computes.
    """

    def __init__(self, single: bool, mine: Collection[Any], products: set[Node], spread: set[Any], slots: SharedSlots):
        """Begin the text of a function, without lines as yet; the class says what the arguments are."""
        self.single, self.mine, self.products, self.spread, self.slots = single, mine, products, spread, slots
        self.lines: list[str] = []
        self.scopes: list[Scope] = [{}]
        self.label, self.first_line = "entry", 0  # of LLVM's basic block that is being written
        self.count = 0  # of names made so far, which are %1, %2, ...
        self.called: set[str] = set()  # functions that must be declared
        self.gathered: set[tuple[int, bool]] = set()  # bits of a number, and whether each lane has entries
        self.read: set[Buffer] = set()  # buffers that all runs share
        self.bases: dict[Buffer, str] = {}
        self.turning: Collection[Buffer] = ()  # shared buffers within loops that have a place for each turn
        self.sums: dict[Buffer, int] = {}  # outputs that are added to sums over runs, and the length of their rows
        self.counted_lanes = ""  # the lanes that count
        self.flushes = False  # whether subnormal numbers are zeros
        self.asking_loop: Loop | None = None  # the loop that asks for memory, and for which
        self.asked_rows: list[PrefetchedRows] = []

    def add(self, text: str) -> str:
        """Append an operation in LLVM's text; return the new name of its result."""
        self.count += 1
        self.lines.append(f"  %t{self.count} = {text}")
        return f"%t{self.count}"

    def line(self, text: str) -> None:
        """Append a line without a result."""
        self.lines.append(f"  {text}")

    def start_basic_block(self, label: str) -> None:
        """Begin a basic block."""
        self.lines.append(f"{label}:")
        self.label, self.first_line = label, len(self.lines)

    def write_block(self, block: Block) -> None:
        """Write the operations and statements of a block that this function computes (`self.mine`), in order."""
        for statement in block.items:
            if statement not in self.mine:
                continue
            if len(self.lines) - self.first_line > LONGEST_BASIC_BLOCK:
                self._go_on_in_new_basic_block()
            if isinstance(statement, Node):
                if statement not in self.products:  # those are written with the sum that they are fused with
                    self._note_name(statement, self._write_node(statement))
            elif isinstance(statement, Store):
                self._write_store(statement)
            elif isinstance(statement, Loop):
                self._write_loop(statement)
            elif isinstance(statement, Guard):
                self._write_guard(statement)

    def _go_on_in_new_basic_block(self) -> None:
        """End the basic block, and begin one that nothing else jumps to."""
        self.count += 1
        self.line(f"br label %next{self.count}")
        self.start_basic_block(f"next{self.count}")

    def _note_name(self, node: Node, name: str) -> None:
        """Note the LLVM name of a node's value; if the function of blocks loads it, a `single` function stores it."""
        self.scopes[-1][node] = name
        if self.single and node in self.slots.places:
            self.slots.store(self, node, name)

    def _write_node(self, node: Node) -> str:
        """Write a node's operation, fused with a product of `self.products` if it adds one; return its name."""
        if node.op == "load":
            return self._write_load(node)
        product = find_fused_product(node, self.products)
        if product is not None:
            addend = node.args[0] if node.args[1] is product else node.args[1]
            names = [self.write_operand(n) for n in (*product.args, addend)]
            return write_fused(node, product, names, self.add)
        if node.op in CALLED:
            self.called.add(name_called_function(node))
        return write_operation(node, [self.write_operand(a) for a in node.args], self.add)

    def write_operand(self, node: Node) -> str:
        """Return the LLVM name of a node's vector: noted in a scope, a constant, or a shared number in all lanes."""
        for scope in reversed(self.scopes):
            if node in scope:
                return scope[node]
        if node.op == "constant":
            name = self.scopes[0][node] = write_splat(node.value, node.type)
            return name
        if node in self.mine and node.op != "counter":
            raise RuntimeError(f"{node} is used before it is computed")
        name = self.scopes[-1][node] = self.write_broadcast(self.write_scalar(node), node.type)
        return name

    def write_scalar(self, node: Node) -> str:
        """Return the name of a number that all lanes share."""
        if node.op == "constant":
            return str(int(node.value))
        key = ("scalar", node)
        for scope in reversed(self.scopes):
            if key in scope:
                return scope[key]
        if node in self.mine or any(node in scope for scope in self.scopes):
            name = self.add(f"extractelement {vector_type(node.type)} {self.write_operand(node)}, i64 0")
        elif node.op == "load" and all(self._is_scalar(i) for i in node.args):
            name = self._write_scalar_load(node)
        else:
            name = self.slots.load(self, node)
        self.scopes[-1][key] = name
        return name

    def _is_scalar(self, node: Node) -> bool:
        """Return whether a number is the same in all lanes."""
        return node.op in ("constant", "counter") or node not in self.mine or self.single

    def write_broadcast(self, name: str, type: Type) -> str:
        """Return the name of a vector that has a scalar in all lanes; in `single` functions a vector has one lane."""
        kind = vector_type(type)
        first = self.add(f"insertelement {kind} poison, {LLVM[type]} {name}, i64 0")
        if self.single:
            return first
        return self.add(f"shufflevector {kind} {first}, {kind} poison, %i32 zeroinitializer")

    def _locate(self, buffer: Buffer, offset: int, strides: Sequence[int], indices: Sequence[Node], entry: str) -> str:
        """Return the address of entry offset + sum strides * indices; `entry` is the type of one."""
        owner, start = buffer.owner
        base = self._write_base(owner)
        # The address of the row by the indices, written once for all entries of it.
        if indices:
            key = ("row", owner, tuple(strides), tuple(indices))
            row = next((scope[key] for scope in reversed(self.scopes) if key in scope), None)
            if row is None:
                moved = ""
                for stride, index in zip(strides, indices, strict=True):
                    step = self.add(f"mul i64 {self.write_scalar(index)}, {stride}")
                    moved = self.add(f"add i64 {moved}, {step}") if moved else step
                row = self.scopes[-1][key] = self.add(f"getelementptr {entry}, ptr {base}, i64 {moved}")
            base = row
        return self.add(f"getelementptr {entry}, ptr {base}, i64 {offset + start}")

    def _write_base(self, owner: Buffer) -> str:
        """Return the address of a buffer's memory; a buffer in `turning` has a copy for each turn of its loops."""
        if owner not in self.turning:
            return self.bases[owner]
        key = ("base", owner)
        base = next((scope[key] for scope in reversed(self.scopes) if key in scope), None)
        if base is None:
            bytes_ = owner.size * BITS[owner.type] // 8
            base = self.scopes[-1][key] = self.write_address_of_turn(self.bases[owner], owner.block, bytes_)
        return base

    def write_address_of_turn(self, start: str, block: Block, bytes_: int) -> str:
        """Return the address of this turn's `bytes_` in memory from `start` on, for the loops around `block`."""
        index = ""
        for loop in block.list_loops():
            assert loop.counter is not None
            step = self.add(f"mul i64 {self.write_scalar(loop.counter)}, {bytes_}")
            index = self.add(f"add i64 {index}, {step}") if index else step
            bytes_ *= loop.length or 1
        return self.add(f"getelementptr i8, ptr {start}, i64 {index}") if index else start

    def _write_load(self, node: Node) -> str:
        """Write the load of a number: one for all lanes, one for each (`spread`), or by each lane's own indices."""
        buffer, offset, strides = node.value
        if not all(self._is_scalar(i) for i in node.args):
            return self._write_gather(node)
        if buffer.owner[0] not in self.spread:
            return self.write_broadcast(self._write_scalar_load(node), node.type)
        address = self._locate(buffer, offset, strides, node.args, f"%i{BITS[node.type]}")
        if node.type == "bool":
            return self.add(f"icmp ne %i8 {self.add(f'load %i8, ptr {address}, align 1')}, zeroinitializer")
        return self.add(f"load {vector_type(node.type)}, ptr {address}, align {BITS[node.type] // 8}")

    def _write_scalar_load(self, node: Node) -> str:
        """Write the load of a number that all lanes share; return the scalar's name. `self.read` notes its buffer."""
        buffer, offset, strides = node.value
        self.read.add(buffer.owner[0])
        address = self._locate(buffer, offset, strides, node.args, f"i{BITS[node.type]}")
        if node.type == "bool":
            return self.add(f"icmp ne i8 {self.add(f'load i8, ptr {address}, align 1')}, 0")
        return self.add(f"load {LLVM[node.type]}, ptr {address}, align {BITS[node.type] // 8}")

    def _write_gather(self, node: Node) -> str:
        """Load a number at a different place in each lane."""
        buffer, offset, strides = node.value
        owner, start = buffer.owner
        bits, spread = BITS[node.type], owner in self.spread
        if not spread:
            self.read.add(owner)
        # Place of each lane: offset + sum strides * indices.
        positions = f"splat (i64 {offset + start})"
        for stride, index in zip(strides, node.args, strict=True):
            step = self.add(f"mul %i64 {self.write_operand(index)}, splat (i64 {stride})")
            positions = self.add(f"add %i64 {step}, {positions}")
        # One load for each lane; booleans are stored as bytes.
        self.gathered.add((bits, spread))
        loaded = self.add(
            f"call %i{bits} @{gather_name(bits, spread)}(ptr {self._write_base(owner)}, %i64 {positions})"
        )
        if node.type == "bool":
            return self.add(f"icmp ne %i8 {loaded}, zeroinitializer")
        return self.add(f"bitcast %i{bits} {loaded} to {vector_type(node.type)}") if node.type in REAL else loaded

    def _write_store(self, store: Store) -> None:
        """Write the store of a number; in a buffer of `sums` it is added, in double, by lanes that have a run."""
        name, kind, bits = self.write_operand(store.node), vector_type(store.node.type), BITS[store.node.type]
        is_sum = store.buffer in self.sums
        entry = f"[{self.sums[store.buffer]} x i64]" if is_sum else f"%i{bits}"
        address = self._locate(store.buffer, store.offset, store.strides, store.indices, entry)
        if is_sum:
            if store.node.type == "f32":
                name, kind = self.add(f"fpext {kind} {name} to %double"), "%double"
            sum_before = self.add(f"load {kind}, ptr {address}, align 8")
            addend = self.add(f"select %i1 {self.counted_lanes}, {kind} {name}, {kind} zeroinitializer")
            name = self.add(f"fadd {kind} {sum_before}, {addend}")
        if store.node.type == "bool":
            name, kind = self.add(f"zext {kind} {name} to %i8"), "%i8"
        self.line(f"store {kind} {name}, ptr {address}, align {bits // 8}")

    def _write_loop(self, loop: Loop) -> None:
        """Write a loop as basic blocks: phi nodes for the numbers that it carries, the body, and the jump back.

        A phi node stands at the beginning of a turn: it has the initial number if control comes from before the loop,
        and the next turn's number if it comes from the end of the body. A counted loop has at least one turn.
        """
        self.count += 1
        name, label_before = f"loop{self.count}", self.label
        # Only the carried numbers that this function computes or reads, by their place in the carry.
        pairs = zip(loop.parameters, loop.results, strict=True)
        carried = [k for k, pair in enumerate(pairs) if any(n in self.mine for n in pair)]
        starts = [self.write_operand(loop.initial[k]) for k in carried]
        self.line(f"br label %{name}")
        self.start_basic_block(name)
        place_of_phis = len(self.lines)
        self.scopes.append({})  # names that hold within a turn
        counter = f"%{name}.counter"
        self._name_parameters(loop, name, counter, carried)
        if loop is self.asking_loop:  # it asks for memory before that is used
            for rows in self.asked_rows:
                requests = write_prefetch_requests(rows, loop.length or 1, counter, WIDTH, self.add)
                self.lines += [f"  {line}" for line in requests]
        # Counted: body, then the latch. Conditional: the check is inside the body.
        if loop.condition is None:
            following = finals = self._write_counted_loop(loop, name, counter, carried)
        else:
            following, finals = self._write_conditional_loop(loop, name, carried)
        # The phi nodes come first, but their arguments are known only now.
        phis = []
        if loop.length:
            phis.append(f"  {counter} = phi i64 [0, %{label_before}], [{counter}.next, %{self.label}]")
        for k, start, after in zip(carried, starts, following, strict=True):
            kind = vector_type(loop.parameters[k].type)
            phis.append(f"  %{name}.p{k} = phi {kind} [{start}, %{label_before}], [{after}, %{self.label}]")
        self.lines[place_of_phis:place_of_phis] = phis
        self.start_basic_block(f"{name}.end")
        self.scopes.pop()
        for k, final in zip(carried, finals, strict=True):
            self._note_name(loop.results[k], final)

    def _name_parameters(self, loop: Loop, name: str, counter: str, carried: list[int]) -> None:
        """Note the names, within a turn, of a loop's counter and of its parameters at the places `carried`."""
        if loop.counter is not None:
            self.scopes[-1]["scalar", loop.counter] = counter
        for k in carried:
            self._note_name(loop.parameters[k], f"%{name}.p{k}")
        if loop.counter is not None and loop.counter in self.mine:
            self._note_name(loop.counter, self.write_operand(loop.counter))

    def _write_counted_loop(self, loop: Loop, name: str, counter: str, carried: list[int]) -> list[str]:
        """Write a counted loop's body and the jump to its next turn; return the names of what that turn is carried."""
        self.write_block(loop.body)
        following = [self.write_operand(loop.following[k]) for k in carried]
        self.line(f"br label %{name}.latch")
        self.start_basic_block(f"{name}.latch")
        self.line(f"{counter}.next = add i64 {counter}, 1")
        turns = "%runs" if loop.length == ANY_LENGTH else loop.length  # a scan gets its rows where others get runs
        self.line(f"%{name}.more = icmp slt i64 {counter}.next, {turns}")
        self.line(f"br i1 %{name}.more, label %{name}, label %{name}.end")
        return following

    def _write_conditional_loop(self, loop: Loop, name: str, carried: list[int]) -> tuple[list[str], list[str]]:
        """Write the body of a loop that ends when no lane's condition holds.

        Returns the names of the carried numbers in the next turn, and of those that are left at the loop's end.
        """
        # The body up to the loop's check, and what follows it in a turn.
        check = next(i for i, s in enumerate(loop.body.items) if isinstance(s, LoopExit) and s.loop is loop)
        head, tail = Block(loop.body.parent), Block(loop.body.parent)
        head.items, tail.items = loop.body.items[:check], loop.body.items[check + 1 :]
        self.write_block(head)
        assert loop.condition is not None
        # Another turn if some lane needs it.
        any_lane = self._write_any_lane(loop.condition)
        self.line(f"br i1 {any_lane}, label %{name}.turn, label %{name}.end")
        self.start_basic_block(f"{name}.turn")
        self.write_block(tail)
        following = [self.write_operand(loop.following[k]) for k in carried]
        self.line(f"br label %{name}.latch")
        self.start_basic_block(f"{name}.latch")
        self.line(f"br label %{name}")
        return following, [f"%{name}.p{k}" for k in carried]

    def _write_any_lane(self, condition: Node) -> str:
        """Write whether a condition holds in some lane; return its name."""
        return self.add(f"icmp ne %lanes {self.add(f'bitcast %i1 {self.write_operand(condition)} to %lanes')}, 0")

    def _write_guard(self, guard: Guard) -> None:
        """Write a guarded block, which is skipped where its condition holds in no lane; its results are zero then."""
        self.count += 1
        name = f"guard{self.count}"
        # Jump past the body if no lane needs it.
        any_lane = self._write_any_lane(guard.condition)
        label_before = self.label
        self.line(f"br i1 {any_lane}, label %{name}, label %{name}.end")
        self.start_basic_block(name)
        self.scopes.append({})
        self.write_block(guard.body)
        used = [k for k, r in enumerate(guard.results) if r in self.mine]
        values = [self.write_operand(guard.values[k]) for k in used]
        label_after = self.label
        self.line(f"br label %{name}.end")
        self.start_basic_block(f"{name}.end")
        self.scopes.pop()
        # A phi node each: the value behind the body, zero where that was skipped. All phi nodes come first, before
        # what `_note_name` may write of one.
        merged = []
        for k, value in zip(used, values, strict=True):
            kind = vector_type(guard.results[k].type)
            merged.append(self.add(f"phi {kind} [{value}, %{label_after}], [zeroinitializer, %{label_before}]"))
        for k, result in zip(used, merged, strict=True):
            self._note_name(guard.results[k], result)
