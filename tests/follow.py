"""A filter stepped over rows of measurements by one compiled scan, and many filters of one structure side by side.

Native code runs them where it supports them, as it does a user's: a quarter of the time that XLA takes to compile.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code, compute_once
from heliograph.filters.base import AbstractFilter
from heliograph.model import Estimate, Innovation
from heliograph.numerics import compile_in_float64

ROWS = 64  # what is compiled serves every number of rows up to the next multiple of it, and rows cost next to nothing
ROWS_OF_EACH = 16  # of thousands of filters side by side they do cost


class Followed(NamedTuple):
    """What a filter says after each row, and its state after the last one.

    Shapes: mean (rows, n), covariance (rows, n, n); innovation of (rows, m), (rows, m, m) and (rows,).
    """

    mean: np.ndarray
    covariance: np.ndarray
    innovation: Innovation
    state: Any


def follow(item: AbstractFilter, z: Any, u: Any = None, written_out: bool = True) -> Followed:
    """Predict and correct over rows, from the filter's start.

    z: (rows, received), or (rows,) for one component, NaN where nothing arrived; u: (rows, inputs). Matrices of many
    entries are not `written_out`, 100,000 instructions of native code: XLA has each product as one operation.
    """
    z = np.array([item.check_measurement(row) for row in z])
    u = np.array([item.check_input(row) for row in (np.zeros((len(z), 0)) if u is None else u)])
    assert len(u) == len(z) and (item.horizon is None or len(z) <= item.horizon)
    arguments = (item, *_padded(z, u), np.asarray(len(z)))
    return _cut(compute_once(_scan, _scan_by_xla, arguments) if written_out else _scan_by_xla(*arguments), len(z), 0)


def follow_known(item: AbstractFilter, z: Any, u: Any) -> Followed:
    """`follow` by a program that knows the filter's numbers, as an exported step does."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.jit(lambda z, u: _scan(item, z, u, len(z)))(np.asarray(z), np.asarray(u)))


def last(item: AbstractFilter, z: Any, u: Any = None) -> Estimate:
    """The estimate after the last of these rows."""
    steps = follow(item, z, u)
    return Estimate(steps.mean[-1], steps.covariance[-1], item.claim)


def follow_each(items: Sequence[AbstractFilter], z: np.ndarray) -> Followed:
    """`follow` of each filter over rows of its own, z (filters, rows, received), with the filters as first axis.

    Filters of one structure are one program, whatever their numbers: a property is tried on all of them at once.
    """
    rows, groups = np.asarray(z), {}
    # An item that stands there several times is taken apart once.
    known = {id(item): jax.tree.flatten(item) for item in items}
    for i, item in enumerate(items):
        leaves, structure = known[id(item)]
        groups.setdefault((structure, tuple(map(np.shape, leaves))), []).append(i)
    parts, order = [], np.concatenate([*groups.values()])
    for (structure, _), members in groups.items():
        names = [id(items[i]) for i in members]
        numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
        columns = zip(*(known[name][0] for name in numbers), strict=True)
        of_each = np.array([numbers[name] for name in names])
        stacked = jax.tree.unflatten(structure, [np.stack(column)[of_each] for column in columns])
        data, inputs = _padded(rows[members], np.zeros((*rows[members].shape[:2], 0)), ROWS_OF_EACH)
        parts.append(_cut(_followed(stacked, data, inputs), rows.shape[1], 1)._replace(state=()))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[np.argsort(order)], *parts)


def apart(estimates, reference):
    """Largest distance of means and of covariances from a reference, in its claimed deviations."""
    (mean, covariance), (other, claimed) = estimates[:2], reference[:2]
    deviation = np.sqrt(np.diagonal(claimed, axis1=1, axis2=2))
    of_covariance = np.abs(covariance - claimed) / (deviation[:, :, None] * deviation[:, None])
    return np.max(np.abs(mean - other) / deviation), np.max(of_covariance)


def _padded(z: np.ndarray, u: np.ndarray, multiple: int = ROWS) -> tuple[np.ndarray, np.ndarray]:
    """Rows in which nothing arrives after the others."""
    more = -z.shape[-2] % multiple
    width = [(0, 0)] * (z.ndim - 2) + [(0, more), (0, 0)]
    return np.pad(z, width, constant_values=np.nan), np.pad(u, width)


def _cut(result: Followed, rows: int, axis: int) -> Followed:
    """Without the rows that were added."""
    steps = jax.tree.map(lambda leaf: np.take(leaf, np.arange(rows), axis), result._replace(state=()))
    return steps._replace(state=result.state)


def _scan(item: AbstractFilter, z: Any, u: Any, last: Any) -> Followed:
    start = jax.tree.map(jnp.asarray, item.init())

    def body(carry: Any, row: Any) -> Any:
        state, until_last = carry
        k, z_k, u_k = row
        after, innovation = item.correct(item.predict(state, u_k, k), z_k, k)
        until_last = jax.tree.map(lambda new, old: jnp.where(k < last, new, old), after, until_last)
        estimate = item.after_step(after, k)
        return (after, until_last), (estimate.mean, estimate.covariance, innovation)

    (_, state), steps = jax.lax.scan(body, (start, start), (jnp.arange(len(z)), z, u))
    return Followed(*steps, state)


_scan_by_xla = compile_in_float64(_scan)


def _followed(items: AbstractFilter, z: Any, u: Any) -> Followed:
    """`_scan` of stacked filters: by native code, or by XLA where that does not support them."""
    with jax.enable_x64(True):
        choice = choose_code(_every_row, (items, z, u), [True] * 3)
        return choice.results() if choice.code is not None else _followed_by_xla(items, z, u)


def _every_row(item: AbstractFilter, z: Any, u: Any) -> Followed:
    return _scan(item, z, u, len(z))


@compile_in_float64
def _followed_by_xla(items: AbstractFilter, z: Any, u: Any) -> Followed:
    return jax.vmap(_every_row)(items, z, u)
