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
from straightline.llvm.shared_slots import SharedSlots, write_address_in_iteration
from straightline.llvm.vector_types_and_gathers import WIDTH, gather_name
from straightline.nodes import REAL, Block, Buffer, Guard, Loop, LoopExit, Node, Store, Type
from straightline.program import find_fused_product
from straightline.size_limits import ANY_LENGTH, LONGEST_BASIC_BLOCK

Scope = dict[Any, str]


class FunctionWriter:
    """Writes the LLVM text of one of a program's two functions: the block function, or that of shared numbers.

    A run is one evaluation of the program. The block function computes what differs between runs, for a block of runs
    at once: each SIMD lane of its vectors has one run. The other function computes once what all runs share.
    """

    def __init__(
        self, single: bool, items: Collection[Any], products: set[Node], per_run: set[Any], slots: SharedSlots
    ):
        """Begin an empty text of LLVM.

        Args:
            single: whether vectors have one lane, as in the function of shared numbers.
            items: the operations and statements of the program that this function computes.
            products: products a b that are written as one operation with the sum that uses them, a b + c.
            per_run: the arrays in memory that have a number for each run of the block, and so for each lane.
            slots: memory of the numbers that all runs share: one function stores them there, the other loads them.
        """
        self.single, self.items, self.products, self.per_run, self.slots = single, items, products, per_run, slots
        # The text, the label and first line of the basic block that is being written, and the LLVM names of the numbers
        # that can be used there; the innermost loop or guard has the last scope.
        self.lines: list[str] = []
        self.label, self.first_line = "entry", 0
        self.scopes: list[Scope] = [{}]
        self.count = 0  # names made so far: %t1, %t2, ...
        # What it needs besides: functions that it calls, loads by an index of each lane (bits of a number, and whether
        # the memory has a number for each lane), and shared memory that it reads.
        self.called: set[str] = set()
        self.gathered: set[tuple[int, bool]] = set()
        self.read: set[Buffer] = set()
        # Memory, set before the text is written: LLVM names of the buffers' addresses; shared buffers with a copy for
        # each iteration of their loops; outputs that are summed over runs, with the length of a row of their sums.
        self.bases: dict[Buffer, str] = {}
        self.per_iteration: Collection[Buffer] = ()
        self.sums: dict[Buffer, int] = {}
        self.lanes_with_run = ""  # LLVM name of the mask of lanes that have a run of their own, and do not repeat one
        self.flushes = False  # whether subnormal numbers are taken for zeros
        # The loop that asks for memory before it is needed, and the rows of memory that it asks for.
        self.prefetching_loop: Loop | None = None
        self.prefetched_rows: list[PrefetchedRows] = []

    def add(self, text: str) -> str:
        """Append an instruction, given without its result as in "add i64 %a, 1"; return the new name of its result."""
        self.count += 1
        self.lines.append(f"  %t{self.count} = {text}")
        return f"%t{self.count}"

    def line(self, text: str) -> None:
        """Append an instruction without a result, such as a store or a jump."""
        self.lines.append(f"  {text}")

    def start_basic_block(self, label: str) -> None:
        """Begin a basic block of LLVM with this label: instructions that are entered only at the first one."""
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
        """End the basic block by a jump to a new one, which nothing else jumps to: long ones take LLVM too long."""
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
        """Return whether a number is known to be equal in all lanes, so that one scalar says it.

        So are constants, loop counters, and numbers that another function computes for all runs (not in `self.items`).
        Where a vector has one lane (`single`) every number is.
        """
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
        owner, start = buffer.owner  # the outermost buffer that contains this one, and this one's first entry in it
        base = self._write_base(owner)
        # The address by the indices, base + sum strides * indices, is written once for all entries of such a row.
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
        """Return the LLVM name of a buffer's address; in `per_iteration`, of its copy for the current iteration."""
        if owner not in self.per_iteration:
            return self.bases[owner]
        key = ("base", owner)
        base = next((scope[key] for scope in reversed(self.scopes) if key in scope), None)
        if base is None:
            size = owner.size * BITS[owner.type] // 8  # in bytes
            base = self.scopes[-1][key] = write_address_in_iteration(self, self.bases[owner], owner.block, size)
        return base

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
        phis = []  # which come first, but their arguments are known only now
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

        Operations in the body look names up in the innermost scope, `self.scopes[-1]`. Carried number k, for the k in
        `carried`, is named %NAME.pk, NAME the loop's `name`. The counter is the scalar `counter`, which addresses use;
        if the body also computes with it, as `self.items` tells, it is copied into a vector with the same in all lanes.
        """
        if loop.counter is not None:
            self.scopes[-1]["scalar", loop.counter] = counter
        for k in carried:
            self._note_name(loop.parameters[k], f"%{name}.p{k}")
        if loop.counter is not None and loop.counter in self.items:
            vector = self.write_operand(loop.counter)
            self._note_name(loop.counter, vector)

    def _write_counted_loop(self, loop: Loop, name: str, counter: str, carried: list[int]) -> list[str]:
        """Write a counted loop's body and the jump back; return the names of the next iteration's carried numbers.

        `name` begins the loop's labels, `counter` names its counter, and `carried` has the numbers of what it carries.
        """
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

        `name` begins the loop's labels. Return the names of the carried numbers (of which `carried` has the indices) in
        the next iteration, and those of the same numbers after the loop.
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
        """Write whether a condition holds in some lane; return the name of this bit."""
        # `%lanes` is the integer type with a bit for each lane.
        lane_bits = self.add(f"bitcast %i1 {self.write_operand(condition)} to %lanes")
        return self.add(f"icmp ne %lanes {lane_bits}, 0")

    def _write_guard(self, guard: Guard) -> None:
        """Write a guarded block: skipped, with results of 0, if its condition holds in no SIMD lane."""
        self.count += 1
        name = f"guard{self.count}"
        # Jump past the body if no lane needs it.
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
