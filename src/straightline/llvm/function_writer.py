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
from straightline.llvm.shared_slots import SharedSlots
from straightline.llvm.vector_types_and_gathers import WIDTH, gather_name
from straightline.nodes import REAL, Block, Buffer, Guard, Loop, LoopExit, Node, Store, Type
from straightline.program import find_fused_product
from straightline.size_limits import ANY_LENGTH, LONGEST_BASIC_BLOCK

Scope = dict[Any, str]


class FunctionWriter:
    """Writes the LLVM text of one of a program's two functions: the block function, or that of shared numbers.

    The block function computes what differs between runs, for a block of runs at once: each SIMD lane of its vectors
    has one run. The other function computes once what all runs share.

    Args:
        single: whether vectors have one lane, as in the function of shared numbers.
        items: the operations and statements that this function computes.
        products: products that are fused with the sum that uses them.
        per_run: the buffers that have a number for each run of the block, and so for each lane.
        slots: memory of the shared numbers that one function computes and the other loads.
    """

    def __init__(
        self, single: bool, items: Collection[Any], products: set[Node], per_run: set[Any], slots: SharedSlots
    ):
        """Begin the text of a function that computes `items`, without lines as yet.

        `single`: vectors have one lane. `products` are fused with their sums. `per_run` are the buffers with a number
        for each lane. `slots` is the memory of numbers that all runs share.
        """
        self.single, self.items, self.products, self.per_run, self.slots = single, items, products, per_run, slots
        self.lines: list[str] = []
        self.scopes: list[Scope] = [{}]
        self.label, self.first_line = "entry", 0  # of LLVM's basic block that is being written
        self.count = 0  # of names made so far, which are %1, %2, ...
        self.called: set[str] = set()  # functions that must be declared
        self.gathered: set[tuple[int, bool]] = set()  # bits of a number, and whether each lane has entries
        self.read: set[Buffer] = set()  # buffers that all runs share
        self.bases: dict[Buffer, str] = {}
        self.per_iteration: Collection[Buffer] = ()  # shared buffers with a copy for each iteration of their loops
        self.sums: dict[Buffer, int] = {}  # outputs that are added to sums over runs, and the length of their rows
        self.lanes_with_run = ""  # name of the mask of lanes that have a run, and do not repeat the last one
        self.flushes = False  # whether subnormal numbers are zeros
        self.prefetching_loop: Loop | None = None  # the loop that prefetches memory, and which rows
        self.prefetched_rows: list[PrefetchedRows] = []

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
        """Write the operations and statements of a block that this function computes (`self.items`), in order."""
        for statement in block.items:
            if statement not in self.items:
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
        """Note the LLVM name of a node's value in the innermost scope, where later operations find it.

        In the function of shared numbers (`single`) the value is also stored if the block function loads it: then the
        node has a slot.
        """
        self.scopes[-1][node] = name
        if self.single and node in self.slots.offsets:
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
        if node in self.items and node.op != "counter":
            raise RuntimeError(f"{node} is used before it is computed")
        name = self.scopes[-1][node] = self.write_broadcast(self.write_scalar(node), node.type)
        return name

    def write_scalar(self, node: Node) -> str:
        """Return the LLVM name of a number that is equal in all lanes, as a scalar; write what computes it if needed.

        It is, in this order: a constant's text; a scalar that was written before, which a scope holds under the key
        ("scalar", node); lane 0 of a vector of this function; a load by indices that are equal in all lanes; or a load
        from the number's slot, which the function of shared numbers stores.
        """
        if node.op == "constant":
            return str(int(node.value))
        key = ("scalar", node)
        for scope in reversed(self.scopes):
            if key in scope:
                return scope[key]
        if node in self.items or any(node in scope for scope in self.scopes):
            name = self.add(f"extractelement {vector_type(node.type)} {self.write_operand(node)}, i64 0")
        elif node.op == "load" and all(self._is_scalar(i) for i in node.args):
            name = self._write_scalar_load(node)
        else:
            name = self.slots.load(self, node)
        self.scopes[-1][key] = name
        return name

    def _is_scalar(self, node: Node) -> bool:
        """Return whether a number is equal in all lanes: every number is if a vector has one lane (`single`)."""
        return node.op in ("constant", "counter") or node not in self.items or self.single

    def write_broadcast(self, name: str, type: Type) -> str:
        """Return the name of a vector that has a scalar in all lanes; in `single` functions a vector has one lane."""
        kind = vector_type(type)
        first = self.add(f"insertelement {kind} poison, {LLVM[type]} {name}, i64 0")
        if self.single:
            return first
        return self.add(f"shufflevector {kind} {first}, {kind} poison, %i32 zeroinitializer")

    def _locate(self, buffer: Buffer, offset: int, strides: Sequence[int], indices: Sequence[Node], entry: str) -> str:
        """Return the address of entry offset + sum strides * indices of a buffer; `entry` is the LLVM type of one."""
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
        """Return the address of a buffer's memory; in `per_iteration`, that of its copy for the current iteration."""
        if owner not in self.per_iteration:
            return self.bases[owner]
        key = ("base", owner)
        base = next((scope[key] for scope in reversed(self.scopes) if key in scope), None)
        if base is None:
            size = owner.size * BITS[owner.type] // 8  # in bytes
            base = self.scopes[-1][key] = self.write_address_in_iteration(self.bases[owner], owner.block, size)
        return base

    def write_address_in_iteration(self, start: str, block: Block, size: int) -> str:
        """Write the address, in memory from `start` on, of the `size` bytes for the current iteration; return its name.

        With the loops around `block`, innermost first, of counters c_1, c_2, ... and lengths n_1, n_2, ..., it is
        start + size (c_1 + n_1 (c_2 + n_2 (c_3 + ...))).
        """
        offset, stride = "", size
        for loop in block.list_loops():
            assert loop.counter is not None
            step = self.add(f"mul i64 {self.write_scalar(loop.counter)}, {stride}")
            offset = self.add(f"add i64 {offset}, {step}") if offset else step
            stride *= loop.length or 1
        return self.add(f"getelementptr i8, ptr {start}, i64 {offset}") if offset else start

    def _write_load(self, node: Node) -> str:
        """Write the load of buffer[offset + sum strides * indices]; return the name of the vector.

        If lanes have different indices, each lane loads a number of its own (gather). Else, if all runs share the
        buffer, one number is loaded and copied to all lanes. Else the entry has a number for each lane (`per_run`),
        which are one vector in memory. A boolean is a byte in memory.
        """
        buffer, offset, strides = node.value
        if not all(self._is_scalar(i) for i in node.args):
            return self._write_gather(node)
        if buffer.owner[0] not in self.per_run:
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
        """Write the load of buffer[offset + sum strides * indices] with each lane's own indices; return its name."""
        buffer, offset, strides = node.value
        owner, start = buffer.owner
        bits, has_lanes = BITS[node.type], owner in self.per_run
        if not has_lanes:
            self.read.add(owner)
        # Position of each lane's number in the buffer: offset + sum strides * indices.
        positions = f"splat (i64 {offset + start})"
        for stride, index in zip(strides, node.args, strict=True):
            step = self.add(f"mul %i64 {self.write_operand(index)}, splat (i64 {stride})")
            positions = self.add(f"add %i64 {step}, {positions}")
        # One load for each lane; booleans are stored as bytes.
        self.gathered.add((bits, has_lanes))
        loaded = self.add(
            f"call %i{bits} @{gather_name(bits, has_lanes)}(ptr {self._write_base(owner)}, %i64 {positions})"
        )
        if node.type == "bool":
            return self.add(f"icmp ne %i8 {loaded}, zeroinitializer")
        return self.add(f"bitcast %i{bits} {loaded} to {vector_type(node.type)}") if node.type in REAL else loaded

    def _write_store(self, store: Store) -> None:
        """Write the store buffer[offset + sum strides * indices] = node, one number for each lane.

        A buffer in `sums` has sums over runs in double precision: the number is added to what is there. An entry is a
        row of 64-bit sums, where each lane adds to a sum of its own. Lanes that only repeat the last run add zero.
        """
        name, kind, bits = self.write_operand(store.node), vector_type(store.node.type), BITS[store.node.type]
        is_sum = store.buffer in self.sums
        entry = f"[{self.sums[store.buffer]} x i64]" if is_sum else f"%i{bits}"
        address = self._locate(store.buffer, store.offset, store.strides, store.indices, entry)
        if is_sum:
            if store.node.type == "f32":
                name, kind = self.add(f"fpext {kind} {name} to %double"), "%double"
            previous_sum = self.add(f"load {kind}, ptr {address}, align 8")
            addend = self.add(f"select %i1 {self.lanes_with_run}, {kind} {name}, {kind} zeroinitializer")
            name = self.add(f"fadd {kind} {previous_sum}, {addend}")
        if store.node.type == "bool":
            name, kind = self.add(f"zext {kind} {name} to %i8"), "%i8"
        self.line(f"store {kind} {name}, ptr {address}, align {bits // 8}")

    def _write_loop(self, loop: Loop) -> None:
        """Write a loop as basic blocks: phi nodes for the numbers that it carries, the body, and the jump back.

        A phi node stands at the beginning of an iteration: it takes the initial number if control comes from before the
        loop, else the one from the end of the body. A counted loop has at least one iteration.
        """
        self.count += 1
        name, label_before = f"loop{self.count}", self.label
        # Only the carried numbers that this function computes or reads, by their index in the carry.
        pairs = zip(loop.parameters, loop.results, strict=True)
        carried = [k for k, pair in enumerate(pairs) if any(n in self.items for n in pair)]
        starts = [self.write_operand(loop.initial[k]) for k in carried]
        self.line(f"br label %{name}")
        self.start_basic_block(name)
        index_of_phis = len(self.lines)
        self.scopes.append({})  # names that hold within an iteration
        counter = f"%{name}.counter"
        self._name_parameters(loop, name, counter, carried)
        if loop is self.prefetching_loop:
            for rows in self.prefetched_rows:
                requests = write_prefetch_requests(rows, loop.length or 1, counter, WIDTH, self.add)
                self.lines += [f"  {line}" for line in requests]
        # Names of the carried numbers after an iteration (`following`) and after the loop (`finals`).
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
        self.lines[index_of_phis:index_of_phis] = phis
        self.start_basic_block(f"{name}.end")
        self.scopes.pop()
        for k, final in zip(carried, finals, strict=True):
            self._note_name(loop.results[k], final)

    def _name_parameters(self, loop: Loop, name: str, counter: str, carried: list[int]) -> None:
        """Note the LLVM names that a loop's counter and carried numbers have within an iteration.

        The counter is the scalar `counter`, and also a vector if this function computes with it. Carried number k, for
        the k in `carried`, is the phi node %NAME.pk, NAME the loop's `name`.
        """
        if loop.counter is not None:
            self.scopes[-1]["scalar", loop.counter] = counter
        for k in carried:
            self._note_name(loop.parameters[k], f"%{name}.p{k}")
        if loop.counter is not None and loop.counter in self.items:
            self._note_name(loop.counter, self.write_operand(loop.counter))

    def _write_counted_loop(self, loop: Loop, name: str, counter: str, carried: list[int]) -> list[str]:
        """Write a counted loop's body and the jump back; return the names of the next iteration's carried numbers."""
        self.write_block(loop.body)
        following = [self.write_operand(loop.following[k]) for k in carried]
        self.line(f"br label %{name}.latch")
        self.start_basic_block(f"{name}.latch")
        self.line(f"{counter}.next = add i64 {counter}, 1")
        iterations = "%runs" if loop.length == ANY_LENGTH else loop.length  # a scan gets its rows where others get runs
        self.line(f"%{name}.more = icmp slt i64 {counter}.next, {iterations}")
        self.line(f"br i1 %{name}.more, label %{name}, label %{name}.end")
        return following

    def _write_conditional_loop(self, loop: Loop, name: str, carried: list[int]) -> tuple[list[str], list[str]]:
        """Write the body of a loop that ends when no lane's condition holds.

        Return the names of the carried numbers in the next iteration, and those of the same numbers after the loop.
        """
        # The body up to the loop's check, and what follows it in an iteration.
        check = next(i for i, s in enumerate(loop.body.items) if isinstance(s, LoopExit) and s.loop is loop)
        head, tail = Block(loop.body.parent), Block(loop.body.parent)
        head.items, tail.items = loop.body.items[:check], loop.body.items[check + 1 :]
        self.write_block(head)
        assert loop.condition is not None
        # Another iteration if some lane needs it.
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
        """Write a guarded block: it is skipped if its condition holds in no SIMD lane; its results are then 0."""
        self.count += 1
        name = f"guard{self.count}"
        # Jump past the body if no lane needs it. `self.label` is the basic block that is being written.
        any_lane = self._write_any_lane(guard.condition)
        label_before = self.label
        self.line(f"br i1 {any_lane}, label %{name}, label %{name}.end")
        self.start_basic_block(name)
        self.scopes.append({})
        self.write_block(guard.body)
        used = [k for k, r in enumerate(guard.results) if r in self.items]
        values = [self.write_operand(guard.values[k]) for k in used]
        label_after = self.label
        self.line(f"br label %{name}.end")
        self.start_basic_block(f"{name}.end")
        self.scopes.pop()
        # For each result that is used later a phi node: its value after the body, or zero if that was skipped. All phi
        # nodes come first, as LLVM demands, before what `_note_name` may write.
        merged = []
        for k, value in zip(used, values, strict=True):
            kind = vector_type(guard.results[k].type)
            merged.append(self.add(f"phi {kind} [{value}, %{label_after}], [zeroinitializer, %{label_before}]"))
        for k, result in zip(used, merged, strict=True):
            self._note_name(guard.results[k], result)
