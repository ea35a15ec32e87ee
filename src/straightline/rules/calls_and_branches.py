"""Rules of inner programs: called functions, and branches, known to be taken or selected in each run.

An expensive branch is computed only if some run takes it (a guarded block).
"""

from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from straightline.lowering import IN_MEMORY, RULES, Lowering, Value, arrange_nodes, estimate_size, make_placeholder
from straightline.nodes import Block, Guard, Node, RandomKey
from straightline.rules.elementwise import select
from straightline.size_limits import DEAR

CALLS = (
    "jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr",
    "checkpoint", "remat", "remat2",
)  # fmt: skip


def _inline_call(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the results of a call of JAX (jit, custom_jvp, ...): its function's program is written in its place.

    So the native program has no calls: the operations of the function are added to it one by one (`lowering`).
    """
    params = equation.params
    # Each kind of call has its own name for the program.
    inner = next(params[name] for name in ("jaxpr", "call_jaxpr", "fun_jaxpr") if name in params)
    return lowering.inline_program(inner, inputs)


def _inline_custom_vmap_call(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the results of a function that has a rule of its own for `vmap`: its program is written in its place."""
    return lowering.inline_program(equation.params["call"], inputs)


def _expand_call(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the results of an operation that JAX defines by other operations, such as frexp in JAX from 0.12 on.

    JAX traces the definition for arguments of these shapes and types, and the traced program is written in the place of
    the operation, as scalar operations of native code (`lowering`).
    """
    # JAX keeps such an operation as an object: `expand` computes its definition, of arguments in the structure
    # `in_tree`.
    primitive = equation.params["_prim"]

    def expand(*leaves: jax.Array) -> list[jax.Array]:
        """Return the leaves of the operation's results from the leaves of its arguments, by its definition."""
        arguments = jax.tree.unflatten(primitive.in_tree, leaves)
        return jax.tree.leaves(primitive.expand(*arguments))

    avals: list[Any] = [v.aval for v in equation.invars]  # shapes and types of the arguments
    definition = jax.make_jaxpr(expand)(*(make_placeholder(a.shape, a.dtype) for a in avals))
    return lowering.inline_program(definition, inputs)


def _select_platform(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the number of the branch for CPUs as a constant; if no branch names CPUs, it is the last branch.

    `platforms` holds for each branch the names of its platforms, or None for any platform.
    """
    platforms = equation.params["platforms"]
    number = next((i for i, names in enumerate(platforms) if names is not None and "cpu" in names), len(platforms) - 1)
    return [lowering.make_known_array(np.int32(number))]


IN_MEMORY |= dict.fromkeys(CALLS, _inline_call)
IN_MEMORY |= {"custom_vmap_call": _inline_custom_vmap_call, "call_hi_primitive": _expand_call}
RULES |= {"platform_index": _select_platform}


def _lower_cond(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Lower JAX's `cond`, the choice of a branch by an index (`inputs[0]`), and return the branch's results.

    To lower is to add single operations (nodes) to a graph. A constant index takes one branch. Otherwise SIMD lanes may
    take different branches, since each lane computes another run of the program: all branches are computed, and each
    lane selects its results.

    Args:
        lowering: holds the graph, and adds nodes to it.
        equation: the operation; its parameters hold the branches as traced programs.
        inputs: the index, and the arguments of the branches.
    """
    # An index known now, or a single branch, needs no choice; an index beyond the ends takes the first or last branch.
    branches = equation.params["branches"]
    which = lowering.get_only_node(inputs[0])
    if which.op == "constant":
        taken = min(max(int(which.value), 0), len(branches) - 1)
        return lowering.inline_program(branches[taken], inputs[1:])
    if len(branches) == 1:
        return lowering.inline_program(branches[0], inputs[1:])
    # Small branches are computed in any case, large ones in guarded blocks, which are skipped where no lane takes them.
    # Numbers of a guarded block cannot be used outside of it. So small branches come first, and larger ones can use
    # equal numbers that these computed.
    conditions = _find_taken_branches(lowering, which, len(branches))
    sizes = [estimate_size(lowering, branch.jaxpr) for branch in branches]
    results: dict[int, list[np.ndarray]] = {}
    for k in sorted(range(len(branches)), key=lambda k: sizes[k]):
        results[k] = _lower_branch(lowering, conditions[k], branches[k], inputs[1:])
    # Select the results of the branch that is taken.
    chosen = results[len(branches) - 1]
    for k in reversed(range(len(branches) - 1)):
        chosen = [_select_arrays(lowering, conditions[k], a, b) for a, b in zip(results[k], chosen, strict=True)]
    return chosen


def _find_taken_branches(lowering: Lowering, which: Node, count: int) -> list[Node]:
    """Return for each of `count` branches the node of a flag: whether the branch is taken.

    `which` is the branch's index, or a flag that chooses between two. An index below 0 takes the first branch, and one
    beyond the last takes the last.
    """
    graph = lowering.graph
    if which.op == "convert" and which.args[0].type == "bool":
        which = which.args[0]  # the flag that the integer was made of
    if which.type == "bool":
        return [graph.node("not", "bool", which), which]
    # Branch k is taken if the index is at most k, but not at most k - 1.
    at_most = [graph.node("le", "bool", which, graph.constant(k, which.type)) for k in range(count - 1)]
    above = [graph.node("not", "bool", flag) for flag in at_most]
    between = [graph.node("and", "bool", above[k - 1], at_most[k]) for k in range(1, count - 1)]
    return [at_most[0], *between, above[-1]]


def _lower_branch(lowering: Lowering, condition: Node, branch: Any, inputs: list[Value]) -> list[np.ndarray]:
    """Compute a branch, and return its results: in the open block if it has few nodes, else in a guarded one.

    A node is a scalar operation of the program. A guarded block is skipped where `condition`, whether the branch is
    taken, holds in no run; DEAR nodes are worth a jump past them.
    """
    graph, outer = lowering.graph, lowering.graph.current
    graph.current = block = Block(outer, pinned=True)
    try:
        results = [lowering.nodes(x) for x in lowering.inline_program(branch, inputs)]
    finally:
        graph.current = outer
    # How many nodes it has is known only now that it is lowered.
    if _count_block_nodes(block) <= DEAR:
        _move_statements_out(block, outer)
        return results
    guard = Guard(block, condition)
    outer.items.append(guard)
    return [
        arrange_nodes([_read_guarded_result(lowering, guard, x) for x in r.ravel().tolist()], r.shape) for r in results
    ]


def _read_guarded_result(lowering: Lowering, guard: Guard, value: Any) -> Any:
    """Return the node that stands for a number of a guarded block outside of it: zero where the block is skipped.

    A number that the block does not compute is returned as it is. A random key is a pair of such numbers.
    """
    if isinstance(value, RandomKey):
        return RandomKey(
            _read_guarded_result(lowering, guard, value.first), _read_guarded_result(lowering, guard, value.second)
        )
    if value.block is not guard.body:
        return value
    if value in guard.values:
        return guard.results[guard.values.index(value)]
    guarded = lowering.graph.make_fresh_node(
        "guarded", value.type, (), lowering.graph.current, (guard, len(guard.values))
    )
    guard.values.append(value)
    guard.results.append(guarded)
    return guarded


def _count_block_nodes(block: Block) -> int:
    """Count the nodes (scalar operations) of a block; a loop, guard or store in it counts as more than DEAR."""
    return sum(1 if isinstance(statement, Node) else DEAR + 1 for statement in block.items)


def _move_statements_out(block: Block, outer: Block) -> None:
    """Move the operations and statements of a block into `outer`, the block around it.

    `seen` holds a block's nodes by operation and arguments, so that equal ones are reused. It moves too.
    """
    for statement in block.items:
        statement.block = outer  # type: ignore[union-attr]
    outer.items += block.items
    outer.seen |= block.seen


def _select_arrays(lowering: Lowering, condition: Node, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the nodes that select array a where the condition, one flag for all entries, holds, else array b.

    Data decide the condition, so that each entry becomes a selection, an operation of the program.
    """
    pairs = zip(a.ravel().tolist(), b.ravel().tolist(), strict=True)
    return arrange_nodes([select(lowering.graph, condition, x, y) for x, y in pairs], a.shape)


IN_MEMORY |= {"cond": _lower_cond}
