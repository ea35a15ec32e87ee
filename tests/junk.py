"""Anything in place of anything, and what a public function may do with it: work, or say in one line what is wrong."""

import inspect
import re
import signal
from contextlib import contextmanager
from decimal import Decimal

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from hypothesis import strategies as st
from jaxtyping import config

import heliograph as hg
from heliograph import filters, fusion, random_affine
from heliograph.simulation.results.record import Record

EYE = np.eye(2)
PLANT = hg.LinearPlant(0.9 * EYE, 0.1, [0.0, 0.0], 1.0)
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.1)
HOP = hg.hop(1.0, 0.1)
KALMAN = hg.kalman_filter(PLANT, SENSOR)
NODE = hg.Node(SENSOR, hg.perfect(), {"f": KALMAN})
SCALAR = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
COIN = random_affine.FiniteSupport([[-1.0], [1.0]], [0.5, 0.5])
ESCAPE = fusion.EscapeQuantizer(9, 1.0, 0.5, 0.1, 1e-3)

ARRAYS = st.builds(
    lambda shape, fill: np.full(shape, fill),
    st.lists(st.integers(0, 3), max_size=3).map(tuple),
    st.sampled_from([0.0, 1.0, -1.0, np.nan, np.inf, 1e300, 1e155, 1e16, 1e-160, 5e-324, "0.1", 10**30]),
)
EDGES = [2**40, 10**30, -(10**30), 5e-324, 1e-160, 1e16, 1e155, -1e308, np.nan, -np.inf, 1j, "0.1", "1e9", "nan"]
# No size that could be built and would fill the memory, and nothing whose double is what overflows.
NUMBERS = st.one_of(st.integers(-4, 4), st.floats(-1e300, 1e300), st.booleans(), st.sampled_from(EDGES))
SOUND = st.characters(exclude_categories=["Cs"])  # all of UTF-8, without a search for what that holds
LISTS = st.recursive(
    st.one_of(NUMBERS, st.none(), st.text(SOUND, max_size=3)), lambda x: st.lists(x, max_size=3), max_leaves=6
)
THINGS = st.sampled_from(
    [None, b"x", object(), set(), {}, {"a": 1}, {1: 2}, lambda x: x, lambda: 0, np.array([None]), range(2), iter([1]),
     int,      PLANT, SENSOR, HOP, KALMAN, NODE, hg.Rayleigh(1.0), COIN, ESCAPE, "exact", np.array("x"), "a\0b",
     slice(None), ..., memoryview(b"1"), pd.NA, pd.Timestamp(0), pd.Timedelta(1), pd.Series(["a"], dtype="category")]
)  # fmt: skip
KINDS = {  # of one and the same numbers: each means what the plain array means, or is refused in one line
    "single": lambda a: np.where(np.abs(a) < 1e30, a, 1.0).astype(np.float32),
    "big-endian": lambda a: a.astype(">f8"),
    "extended": lambda a: a.astype(np.longdouble),
    "objects": lambda a: a.astype(object),
    "decimals": lambda a: np.vectorize(lambda x: Decimal(repr(float(x))), otypes=[object])(a) if a.size else a,
    "read-only": lambda a: np.frombuffer(a.tobytes()).reshape(a.shape),
    "strided": lambda a: np.repeat(a, 2, axis=-1)[..., ::2] if a.ndim else a,
    "reversed": lambda a: a[::-1].copy()[::-1] if a.ndim else a,
    "in columns": lambda a: np.array(a, order="F"),
    "masked nowhere": np.ma.array,
    "of JAX": lambda a: jnp.asarray(np.where(np.abs(a) < 1e30, a, 1.0)),  # in single precision
    "of pandas": lambda a: pd.Series(a, range(5, 5 + len(a))) if a.ndim == 1 else pd.DataFrame(a) if a.ndim == 2 else a,
    "nullable": lambda a: pd.array(a, dtype="Float64") if a.ndim == 1 else a,
    "of xarray": xr.DataArray,
}
MORE = {  # and what is no such array
    "masked": lambda a: np.ma.masked_all(a.shape),
    "complex": lambda a: a + 0j,
    "bytes": lambda a: np.full(a.shape, b"1"),
    "records": lambda a: np.zeros(a.shape, [("x", "f8")]),
    "too large": lambda a: np.full(a.shape, 10**400, dtype=object),
    "NA": lambda a: np.full(a.shape, pd.NA),
    "spans": lambda a: np.full(a.shape, np.timedelta64(1, "ns")),
    **{f"dates by {unit}": lambda a, u=unit: np.full(a.shape, np.datetime64(0, u)) for unit in ("Y", "D", "s", "ns")},
    "key": lambda a: jax.random.key(0),
    "set of arrays": lambda a: xr.Dataset({"a": ("t", np.ones(2))}),
}
KINDS_OF_ARRAYS = st.builds(
    lambda kind, a: ((KINDS | MORE)[kind])(a.astype(float)), st.sampled_from(sorted(KINDS | MORE)), ARRAYS
)
JUNK = st.one_of(NUMBERS, st.text(SOUND, max_size=4), ARRAYS, KINDS_OF_ARRAYS, LISTS, THINGS)
RAW = re.compile(r"e-308|\bany, any\b|\bto inf\b|pydantic|validation error|Tracer")  # words of the works inside
LENGTH = 500  # of a line that somebody reads
SECONDS = 60.0  # that one call may take on a busy machine


def name_of(call):
    return getattr(call, "__qualname__", type(call).__name__)


def check(call, arguments, data):
    """Call it with one argument replaced by anything."""
    name = data.draw(st.sampled_from(sorted(arguments)), label="argument")
    value = data.draw(JUNK, label="value")
    judged(call, {**arguments, name: value})


def judged(call, arguments):
    """It works, or one line names the thing, what was expected, and what came; and it ends.

    Without the checker that tests run under: its refusals would come before the function's own words.
    """
    try:
        with ending(SECONDS), without_checker():
            result = call(**arguments)
            false = [] if inspect.isclass(call) else false_claims(result)  # a class holds what it is given
    except (ValueError, TypeError) as error:
        message = str(error)
        assert "\n" not in message and len(message) < LENGTH
        assert ": expected " in message and ", got " in message, message
        assert not RAW.search(message.partition(": expected ")[2].partition(", got ")[0]), message
    else:
        assert not false, false


def false_claims(result):
    """What a result claims of NaN: an estimate by its claim, a filter live, a record without failures."""
    if isinstance(result, hg.model.Estimate):
        return [] if np.ndim(result.mean) != 1 or (result.claims == result.claim).all() else [result]
    if isinstance(result, filters.AbstractFilter):
        stream = hg.Stream(result)
        given = np.zeros(len(result.inputs))
        return [
            false
            for z in (0.1, np.nan, 0.2)
            if result.horizon is None or stream.steps < result.horizon
            for false in false_claims(stream.push(np.full(result.received, z), given))
        ]
    if isinstance(result, Record):
        lost = [
            (node, name, estimate)
            for node, every in result.estimates.items()
            for name, estimate in every.items()
            if estimate.claim != "none" and (estimate.claims == "none").any()
        ]
        return lost if len(result.failures()) < len(lost) else []
    return []


@contextmanager
def without_checker():
    """What users see, who have no checker of types."""
    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        config.update("jaxtyping_disable", before)


class EndlessError(Exception):
    """Nothing was said for too long."""


@contextmanager
def ending(seconds):
    """Raise where the block takes longer; of the main thread alone, which is where tests run."""

    def stop(*_):
        raise EndlessError(f"no end after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
