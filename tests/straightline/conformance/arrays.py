"""Cases of operations on arrays: indices in and out of range, known or of the data; reductions; what moves entries."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from tests.straightline.conformance.case import DTYPES, Case, numbers

WHOLE = (np.int32, np.int64, np.uint32, np.uint64)
RANDOM = np.random.default_rng(7)
NUMBERS, DISCRETE = [d for d in DTYPES if d != np.bool_], [d for d in DTYPES if d != np.float64]
MODES = ("fill", "clip", "promise_in_bounds")


def indices(dtype: Any, size: int) -> np.ndarray:
    """Indices inside an axis, at its ends and outside, up to the ends of their type."""
    ends = np.iinfo(dtype)
    inside = [0, 1, size - 1, size, size + 1, 2 * size]
    below = [-1, -size, -size - 1, ends.min] if ends.min < 0 else []
    return np.array([*inside, *below, ends.max], dtype)


def array(dtype: Any, *shape: int) -> np.ndarray:
    """Numbers of a type that differ from each other as far as they can."""
    count = int(np.prod(shape))
    if dtype == np.float64:
        return RANDOM.normal(size=shape)
    return np.resize(RANDOM.permutation(numbers(dtype)), count).reshape(shape)


def repeated(x: np.ndarray, runs: int) -> np.ndarray:
    """The same array in each run."""
    return np.repeat(x[None], runs, 0)


def _indexed(
    function: Callable[..., Any], x: np.ndarray, axis: int = 0, kinds: Any = WHOLE, label: str = ""
) -> list[Case]:
    """Cases of function(x, index) for each type of the index."""
    cases = []
    for kind in kinds:
        k = indices(kind, x.shape[axis])
        cases.append(
            Case(function, (repeated(x, len(k)), k), label=f"{label} {x.dtype} {x.shape} {np.dtype(kind).name}")
        )
    return cases


def _gathers() -> list[Case]:
    cases = []
    for mode in MODES:

        def get(x, k, m=mode):
            return x.at[k].get(mode=m)

        for dtype in DTYPES:
            cases += _indexed(get, array(dtype, 5), kinds=WHOLE if dtype == np.float64 else WHOLE[:1], label=mode)
        cases += _indexed(get, array(np.float64, 40), label=mode)
        cases += _indexed(get, array(np.float64, 300), label=mode)
        cases += _indexed(get, array(np.float64, 1), label=mode)
        cases += _indexed(get, array(np.float64, 4, 3), label=mode)
        cases += _indexed(lambda x, k, m=mode: x.at[:, k].get(mode=m), array(np.float64, 4, 3), 1, label=mode)
        cases += _indexed(
            lambda x, k, m=mode: x.at[jnp.stack([k, k * 0, k + 1])].get(mode=m),
            array(np.float64, 6),
            kinds=WHOLE[:2],
            label=mode + " rows",
        )
        cases += _indexed(
            lambda x, k, m=mode: x.at[jnp.stack([k, k * 0, k + 1])].get(mode=m),
            array(np.float64, 90, 2),
            kinds=WHOLE[:2],
            label=mode + " rows",
        )
        cases += _indexed(lambda x, k, m=mode: x.at[k, 1].get(mode=m), array(np.float64, 4, 3), label=mode)
        cases += _indexed(
            lambda x, k, m=mode: x.at[k, k].get(mode=m), array(np.float64, 4, 3), kinds=WHOLE[:2], label=mode
        )
        cases += _indexed(
            lambda x, k, m=mode: x.at[k, 9].get(mode=m), array(np.float64, 4, 3), kinds=WHOLE[:2], label=mode
        )
        cases += _indexed(
            lambda x, k, m=mode: jnp.asarray(np.arange(70.0)).at[k].get(mode=m),
            array(np.float64, 70),
            label=mode + " table",
        )
    cases += _indexed(lambda x, k: x.at[k].get(mode="fill", fill_value=-5), array(np.float64, 4), label="-5")
    cases += _indexed(lambda x, k: x.at[k].get(mode="fill", fill_value=7), array(np.int32, 4), label="7")
    cases += _indexed(lambda x, k: x[k], array(np.float64, 4))
    cases += _indexed(jnp.take, array(np.float64, 4))
    cases += _indexed(
        lambda x, k: jnp.take_along_axis(x, jnp.broadcast_to(k, (2, 1)), 1), array(np.float64, 2, 3), 1, WHOLE[:2]
    )
    cases += _indexed(
        lambda x, k: jax.vmap(lambda r, j: r[j])(x, jnp.stack([k, k + 1])), array(np.float64, 2, 3), 1, WHOLE[:2]
    )
    cases += _indexed(lambda x, k: x[jnp.array([2, 0, 9, -1])] + k, array(np.float64, 3), kinds=WHOLE[:1])
    return cases


def _slices() -> list[Case]:
    cases = []
    for size in (1, 3):

        def cut(x, k, n=size):
            return lax.dynamic_slice(x, (k,), (n,))

        cases += [c for d in DTYPES for c in _indexed(cut, array(d, 5))]
        cases += _indexed(cut, array(np.float64, 40)) + _indexed(cut, array(np.float64, 300))
    cases += _indexed(lambda x, k: lax.dynamic_slice(x, (k, k), (2, 2)), array(np.float64, 4, 3))
    cases += _indexed(lambda x, k: lax.dynamic_slice(x, (k, k), (2, 2)), array(np.float64, 30, 30))
    cases += _indexed(lambda x, k: lax.dynamic_slice(x, (k,), (5,)), array(np.float64, 5))
    return cases


def _updates() -> list[Case]:
    cases = []
    for size in (1, 3):

        def put(x, k, n=size):
            return lax.dynamic_update_slice(x, x[:n] * 0, (k,))

        cases += [c for d in DTYPES if d != np.bool_ for c in _indexed(put, array(d, 5))] + _indexed(
            put, array(np.float64, 40)
        )
    cases += _indexed(lambda x, k: lax.dynamic_update_slice(x, x[:2, :2] * 2, (k, k)), array(np.float64, 4, 3))
    return cases


def _scatters(method: str) -> list[Case]:
    cases = []
    for mode in ("drop", "clip", "promise_in_bounds"):
        for dtype in (np.float64, np.int32, np.uint64):
            cases += _indexed(
                lambda x, k, m=mode: getattr(x.at[k], method)(jnp.asarray(3, x.dtype), mode=m),
                array(dtype, 5),
                label=mode,
            )
        cases += _indexed(
            lambda x, k, m=mode: getattr(x.at[k], method)(x[0], mode=m),
            array(np.float64, 4, 3),
            kinds=WHOLE[:1],
            label=mode,
        )
        cases += _indexed(
            lambda x, k, m=mode: getattr(x.at[:, k], method)(x[:, 0], mode=m),
            array(np.float64, 4, 3),
            1,
            WHOLE[:1],
            label=mode,
        )
        cases += _indexed(
            lambda x, k, m=mode: getattr(x.at[k, k], method)(7.0, mode=m),
            array(np.float64, 3, 3),
            kinds=WHOLE[:2],
            label=mode,
        )
        cases += _indexed(
            lambda x, k, m=mode: getattr(x.at[jnp.stack([k, k, k * 0])], method)(
                jnp.asarray([2.0, 5.0, 3.0], x.dtype), mode=m
            ),
            array(np.float64, 4),
            kinds=WHOLE[:2],
            label=mode + " twice",
        )
        cases += _indexed(
            lambda x, k, m=mode: getattr(x.at[jnp.array([1, 1, 9, -1])], method)((2.0 + k).astype(x.dtype), mode=m),
            array(np.float64, 4),
            kinds=WHOLE[:1],
            label=mode + " known",
        )
    return cases


def _rows(dtype: Any, length: int, runs: int = 40, reals: np.ndarray | None = None) -> np.ndarray:
    """Runs of rows of edge values in random order, ties among them."""
    table = numbers(dtype) if reals is None or dtype != np.float64 else reals
    return table[RANDOM.integers(0, len(table), (runs, length))]


def _zeros_and_nan(length: int) -> np.ndarray:
    return RANDOM.choice(np.array([np.nan, -np.nan, 0.0, -0.0, 1.0, -1.0, np.inf]), (40, length))


def _sorts() -> list[Case]:
    cases = []
    for dtype in DTYPES:
        for length in (1, 2, 7):
            cases.append(
                Case(
                    lambda x: (jnp.sort(x), jnp.argsort(x), jnp.sort(x, descending=True)),
                    (_rows(dtype, length),),
                    label=f"{np.dtype(dtype).name} {length}",
                )
            )
    for length in (2, 7):
        both = (_zeros_and_nan(length), _rows(np.int32, length))
        cases.append(
            Case(
                lambda x, k: (
                    lax.sort((x, k), num_keys=1),
                    lax.sort((x, k), num_keys=2),
                    jnp.argsort(x),
                    jnp.median(x),
                ),
                both,
                2.0,
            )
        )
    cases.append(Case(lambda x: jnp.sort(x, axis=0), (_rows(np.float64, 12).reshape(40, 4, 3),)))
    cases.append(Case(jnp.sort, (np.zeros((2, 0)),)))
    return cases


EXACT = np.array(
    [np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 2.0**31, 170.0, 3.0]
)  # sums have no rounding
POWERS = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 0.5, -2.0, 4.0, 1.0, -1.0])  # nor have products


def _reductions(function: Callable[..., Any], dtypes: Any = DTYPES, reals: np.ndarray | None = None) -> list[Case]:
    """Of short and long rows, of none, and row by row."""
    cases = []
    for dtype in dtypes:
        kind = np.dtype(dtype).name
        cases += [Case(function, (_rows(dtype, n, 40, reals),), label=f"{kind} {n}") for n in (1, 2, 5, 90)]
        cases.append(Case(lambda x: function(x[:0]), (_rows(dtype, 2)[:3],), label=f"{kind} empty"))
        short, long = _rows(dtype, 6, 40, reals), _rows(dtype, 90, 40, reals)
        cases.append(Case(lambda x: function(x.reshape(3, 2), axis=0), (short,), label=f"{kind} rows"))
        cases.append(Case(lambda x: function(x.reshape(45, 2), axis=0), (long,), label=f"{kind} long rows"))
    if np.float64 in dtypes:
        cases.append(Case(function, (_zeros_and_nan(4),), label="zeros"))
    return cases


def _by(name: str) -> Callable[..., Any]:
    """A reduction of lax over one axis, which keeps the type."""
    primitive = getattr(lax, f"{name}_p")

    def reduce(x: jax.Array, axis: int = 0) -> Any:
        return primitive.bind(
            x,
            axes=(axis,),
            **({"out_sharding": None} if name in ("reduce_sum", "reduce_max", "reduce_min", "reduce_prod") else {}),
        )

    return reduce


def _non_empty(cases: list[Case]) -> list[Case]:
    return [c for c in cases if "empty" not in c.label]


def _cumulative(function: Callable[..., Any], reals: np.ndarray | None = None, dtypes: Any = DTYPES) -> list[Case]:
    def backwards(x: jax.Array, axis: int = 0) -> jax.Array:
        return function(x, axis=axis, reverse=True)

    return _reductions(function, dtypes, reals) + _reductions(backwards, dtypes, reals)


def _arg(function: Callable[..., Any]) -> list[Case]:
    return [
        c for t in (np.int32, np.int64) for c in _non_empty(_reductions(lambda x, axis=0, t=t: function(x, axis, t)))
    ]


def _products() -> list[Case]:
    cases = []
    for a in DTYPES:
        for b in DTYPES:
            x, y = _rows(a, 6, 40, EXACT).reshape(-1, 2, 3), _rows(b, 6, 40, EXACT).reshape(-1, 3, 2)
            cases.append(Case(jnp.matmul, (x, y), 8.0, f"{np.dtype(a).name} {np.dtype(b).name}"))
        x = _rows(a, 6, 40, EXACT)
        cases.append(Case(lambda x: (jnp.dot(x, x), jnp.outer(x, x), x[:0] @ x[:0]), (x,), 8.0, np.dtype(a).name))
        x = _rows(a, 180, 20, EXACT).reshape(-1, 60, 3)
        cases.append(
            Case(
                lambda x: (x @ x[0], x @ x[:3], jnp.einsum("ij,kj->ik", x[:3], x)),
                (x,),
                8.0,
                f"{np.dtype(a).name} long",
            )
        )
        cases.append(
            Case(
                lambda x: jnp.einsum("bij,bjk->bik", x.reshape(2, 2, 3)[..., :2], x.reshape(2, 2, 3)[..., :2]),
                (_rows(a, 12, 40, EXACT),),
                8.0,
                f"{np.dtype(a).name} batch",
            )
        )
    cases.append(
        Case(
            lambda a, b: lax.dot(a, b, preferred_element_type=np.int64),
            (_rows(np.int32, 4).reshape(-1, 2, 2), _rows(np.int32, 4).reshape(-1, 2, 2)),
            label="wider",
        )
    )
    cases.append(Case(lambda a: lax.dot(a > 0, a > 0), (_rows(np.float64, 4).reshape(-1, 2, 2),), label="truths"))
    return cases


def _moves(function: Callable[..., Any], *shapes: tuple[int, ...]) -> list[Case]:
    return [
        Case(function, (_rows(d, int(np.prod(s)), 2).reshape(2, *s),), label=f"{np.dtype(d).name} {s}")
        for d in DTYPES
        for s in shapes
    ]


SMALL, LONG = (3, 4), (50, 2)
CASES: dict[str, list[Case]] = {
    "gather": _gathers(),
    "dynamic_slice": _slices(),
    "dynamic_update_slice": _updates(),
    "sort": _sorts(),
    "scatter": _scatters("set"),
    "scatter-add": _scatters("add"),
    "scatter-mul": _scatters("multiply"),
    "scatter-min": _scatters("min"),
    "scatter-max": _scatters("max"),
    "scatter-sub": _scatters("subtract"),
    "reduce_sum": _reductions(_by("reduce_sum"), NUMBERS, EXACT),
    "reduce_prod": _reductions(_by("reduce_prod"), NUMBERS, POWERS),
    "reduce_max": _reductions(_by("reduce_max")),
    "reduce_min": _reductions(_by("reduce_min")),
    "reduce_or": _reductions(_by("reduce_or"), DISCRETE),
    "reduce_and": _reductions(_by("reduce_and"), DISCRETE),
    "reduce_xor": _reductions(_by("reduce_xor"), DISCRETE),
    "cumsum": _cumulative(lax.cumsum, EXACT, NUMBERS),
    "cumprod": _cumulative(lax.cumprod, POWERS, NUMBERS),
    "cummax": _cumulative(lax.cummax, dtypes=NUMBERS),
    "cummin": _cumulative(lax.cummin, dtypes=NUMBERS),
    "argmax": _arg(lax.argmax),
    "argmin": _arg(lax.argmin),
    "dot_general": _products(),
    "broadcast_in_dim": _moves(
        lambda x: (jnp.broadcast_to(x[:1], (5, *x.shape)), jnp.broadcast_to(x[:, :1], x.shape)), SMALL, LONG
    ),
    "concatenate": _moves(
        lambda x: (jnp.concatenate([x, x[::-1]]), jnp.concatenate([x, x], 1), jnp.concatenate([x[:0], x])), SMALL, LONG
    ),
    "expand_dims": _moves(lambda x: x[:, None], SMALL, LONG),
    "reshape": _moves(lambda x: x.reshape(-1, 2), SMALL, LONG),
    "rev": _moves(lambda x: (x[::-1], x[:, ::-1], jnp.flip(x)), SMALL, LONG),
    "slice": _moves(lambda x: (x[1:], x[::2], x[1:1], x[-1:, 1::3]), SMALL, LONG),
    "split": _moves(lambda x: jnp.split(x, [1, 2]), SMALL, LONG),
    "squeeze": _moves(lambda x: jnp.squeeze(x[:1], 0), SMALL, LONG),
    "stack": _moves(lambda x: (jnp.stack([x, x]), jnp.stack([x, x], -1)), SMALL),
    "tile": _moves(lambda x: lax.tile(x, (2, 3)), SMALL),
    "transpose": _moves(lambda x: x.T, SMALL, LONG),
    "unstack": _moves(jnp.unstack, SMALL),
    "pad": _moves(
        lambda x: [
            lax.pad(x, x[0, 0], c) for c in ([(1, 2, 0), (0, 0, 1)], [(-1, 1, 2), (2, -1, 0)], [(0, 0, 0), (-2, -2, 0)])
        ],
        SMALL,
    ),
    "iota": [
        Case(lambda x, d=d: (lax.iota(d, 5), lax.broadcasted_iota(d, (2, 3), 1), lax.iota(d, 0)), (np.zeros(2),))
        for d in DTYPES
        if d != np.bool_
    ],
    "empty": [],
    "empty2": [],
}
CASES |= {"scatter_add": CASES["scatter-add"], "scatter_mul": CASES["scatter-mul"]}
