"""Interface of every filter: deterministic predictions and corrections of an explicit state, with sizes and a claim."""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import TYPE_CHECKING, NoReturn, ParamSpec, TypeVar, cast

import equinox as eqx
import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.engine.choice import compile_on_call
from heliograph.filters.angle_indices import FilterAngles
from heliograph.filters.call_checks import call_with_inputs, call_with_state
from heliograph.filters.derivatives_of_likelihood import evaluate_for_derivatives, take_derivatives_from
from heliograph.filters.plausibility import Judgement, judge_step
from heliograph.filters.remark import Remark
from heliograph.filters.rows.chunks import ScanResult
from heliograph.filters.rows.run_over_data import Filtered, run_over_data, scan_inside_jit, step_over_row
from heliograph.filters.sizes import make_sizes
from heliograph.filters.smoother_step import SmootherStep, StepTrace, make_smoother_step
from heliograph.filters.vector_check import check_vector
from heliograph.model.assumed.assumed_model import NOTHING, AssumedModel, StaticAssumedModel, believes
from heliograph.model.checks.plant_inputs import check_time_step, do_inputs_spoil
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import steps_covered
from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.lazy_exports import refuse_attribute
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.types import Array, ArrayLike, Float, Int, PyTree

__all__ = ["AbstractFilter", "AbstractSizedFilter", "FilterAngles", "Step", "believes", "check_step_number",
           "corrects", "estimates", "in_float64", "make_sizes", "predicts"]  # fmt: skip

Step = TypeAliasType("Step", int | np.integer | Int[Array, ""])

P = ParamSpec("P")
R = TypeVar("R")

INSTEAD = {  # what other packages call what a filter does here
    "update": "filter.correct(state, z), or filter.step(state, z, u), which predicts too",
    "filter": "filter.run(z, u) for rows of measurements",
    "smooth": "hg.rts_smoother(filter, z, u)",
    "gain": "hg.steady_state(plant, sensor).gain",
}


@readable
class AbstractFilter(Module):
    """A filter: `predict` moves its state over a step, `correct` uses a measurement, `estimate` returns the estimate.

    Deterministic: the same state and data give the same result. It receives no random key; a filter that draws holds
    one in its state, into which it folds the data (`docs/extend.md` has one). A component of z that is NaN did not
    arrive and is skipped. The state is a pytree of arrays, so one filter object serves a stream, a recording and
    thousands of runs at once.
    To write one: give the four static fields, `predict` under `@predicts`, `correct` under `@corrects`, `estimate`
    under `@estimates`, and `init` under `@in_float64` where it computes anything. Data of other sizes are refused.

    Args:
        claim: what the covariance is: "exact", "upper", "nominal" or "none".
        states: names of the states that are estimated, n of them.
        inputs: names of the inputs that `predict` takes.
        received: length of the measurement z; 0 for a filter that uses none, and then z may have any length.
        kept: the assumed model, which the claim is about, as `believes` keeps it; none where a filter has none.
    """

    claim: eqx.AbstractVar[Claim]
    states: eqx.AbstractVar[tuple[str, ...]]
    inputs: eqx.AbstractVar[tuple[str, ...]]
    received: eqx.AbstractVar[int]
    kept: StaticAssumedModel = eqx.field(static=True, default=NOTHING, init=False, repr=False, compare=False)

    if not TYPE_CHECKING:  # a type checker knows all attributes

        def __getattr__(self, name: str) -> NoReturn:
            """Refuse an attribute that does not exist with what to write instead, or the names most like it."""
            refuse_attribute(self, name, INSTEAD)

    def init(self) -> PyTree:
        """Return the filter's state before the first step: what it knows of x_0 before any data, as a pytree."""
        raise unwritten(self, "init")

    def predict(self, state: PyTree, u: ArrayLike = (), k: Step = 0) -> PyTree:
        """Predict over step k with the input u (inputs,): from the state before the step to the prior after it."""
        raise unwritten(self, "predict")

    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct with the measurement z (received,) of step k; where nothing arrived, the state stays as it is."""
        raise unwritten(self, "correct")

    def estimate(self, state: PyTree) -> Estimate:
        """Return mean (n,) and covariance (n, n): the prediction after `predict`, the posterior after `correct`.

        Raises:
            ValueError: a state of another form than the filter's.
        """
        raise unwritten(self, "estimate")

    @property
    def remarks(self) -> bool:
        """True if the filter defines a `remark` of its own, which may have something to say."""
        return type(self).remark is not AbstractFilter.remark

    def remark(self, state: PyTree) -> Remark:
        """Say what happened to a state that its user should know, and how often; nothing by default."""
        return Remark()

    def step(self, state: PyTree, z: ArrayLike, u: ArrayLike = (), k: Step = 0) -> tuple[PyTree, Estimate]:
        """Predict over step k with the input u, then correct with the measurement z.

        Args:
            state: the filter's state after step k - 1.
            z: measurement (received,); NaN for a component that did not arrive.
            u: input (inputs,) over the step.
            k: number of the step, from 0.

        Returns:
            The state and the estimate after the step.

        Raises:
            ValueError: a state of another form than the filter's; z, u or k of another size; infinite values; an input
                that is NaN.
        """
        z, u = self.check_measurement(z), self.check_input(u)
        return call_with_inputs(self, state, step_over_row, z, u, check_step_number(self, k))

    def run(
        self,
        z: Float[ArrayLike, "steps received"],
        u: Float[ArrayLike, "steps inputs"] | None = None,
        after: Filtered | None = None,
    ) -> Filtered:
        """Run the filter over rows of data from its initial state: for each row predict, then correct.

        Rows that do not fit into memory may be run in blocks: give each call the result of the block before it as
        `after`. Every number is used as it is; `hg.run` leaves out implausible numbers, and warns. From 32,768 rows on
        a linear filter takes chunks of rows side by side if it forgets its start within 512 rows; from 131,072 rows
        on, within 2,048 rows. The results equal those row by row to 1e-10 of a deviation.

        Args:
            z: measurements (steps, received), or (steps,) of one number; NaN for what did not arrive.
            u: inputs (steps, inputs), for each row the input that led to it; by default a filter without inputs.
            after: this filter's result of the rows before these; none by default.

        Raises:
            ValueError: data of another size than the filter's, infinite values, more steps than the filter covers;
                a result of another filter, or of rows that are not before these.
        """
        return run_over_data(self, z, u, after)

    def scan(
        self,
        z: Float[Array, "steps received"],
        u: Float[Array, "steps inputs"],
        output: Callable[[PyTree, Innovation, jax.Array], PyTree],
    ) -> PyTree:
        """Run over rows inside a compiled computation, unchecked, and stack output(state, innovation, k) of all rows.

        Args:
            z: measurements, NaN for what did not arrive.
            u: inputs, for each row the input that led to it.
            output: returns arrays from the state after a row, the row's innovation and its number.
        """
        return scan_inside_jit(self, z, u, output)

    def judge_step(
        self, state: PyTree, z: ArrayLike, u: ArrayLike = (), k: Step = 0
    ) -> tuple[PyTree, Estimate, Judgement, Innovation]:
        """Step like `step`, judge whether z and u are plausible, and return the innovation too.

        If the judgement finds something implausible, the returned state should be discarded.

        Raises:
            ValueError: what `step` refuses.
        """
        z, u = self.check_measurement(z), self.check_input(u)
        return call_with_state(self, state, step_with_judgement, z, u, check_step_number(self, k))

    def step_with_smoother(
        self, state: PyTree, z: ArrayLike, u: ArrayLike = (), k: Step = 0
    ) -> tuple[PyTree, SmootherStep]:
        """Step like `step`, and return the state and what a backward pass over the data needs of the step.

        Raises:
            ValueError: what `step` refuses; a filter that cannot be smoothed.
        """
        z, u = self.check_measurement(z), self.check_input(u)
        return call_with_inputs(self, state, _step_with_smoother, z, u, check_step_number(self, k))

    def check_measurement(self, z: ArrayLike) -> Float[Array, " received"]:
        """Return z as a measurement of the filter's length, NaN where a component did not arrive; empty if unused.

        Raises:
            ValueError: another length, infinite values.
        """
        values = check_vector("measurement", z, self.received or None)
        if isinstance(values, np.ndarray) and np.isinf(values).any():
            raise fail("measurement", "numbers, or NaN for what is missing", np.asarray(values).tolist())
        return values if self.received else values[:0]  # of no length for a filter without measurements

    def check_input(self, u: ArrayLike) -> Float[Array, " inputs"]:
        """Return u as an input of the filter's length.

        Raises:
            ValueError: another length, values that are not finite, a step of time that is not positive.
        """
        values = check_vector(f"inputs {list(self.inputs)}" if self.inputs else "inputs", u, len(self.inputs))
        if isinstance(values, np.ndarray) and not np.isfinite(values).all():
            raise fail("inputs", "finite numbers", np.asarray(values).tolist())
        if isinstance(values, np.ndarray):
            check_time_step(self.inputs, values)
        return values

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return what the backward pass needs of a step, from the filter's states around it.

        Raises:
            ValueError: a filter without a covariance that `correct` updates, or without a known motion of its state.
        """
        raise fail("smoothing", "a filter that keeps its covariance and says how its state moves", type(self).__name__)

    def after_step(self, state: PyTree, k: Step) -> Estimate:
        """Return the estimate after step k: `estimate(state)`, unless the filter looks its covariance up by k."""
        return self.estimate(state)

    def filter_rows(self, z: Array, u: Array, state: PyTree | None = None, begin: Array | int = 0) -> ScanResult | None:
        """Filter rows, the first of number `begin`, from `state` by native code of its own; most filters have none."""
        return None

    @property
    def is_linear(self) -> bool:
        """True if the estimate is the state's mean, an affine function of the data, and data change nothing else.

        Covariances and gains are then known before any data, and each of its steps is a `LinearStep`.
        """
        return False

    @property
    def has_score_recursion(self) -> bool:
        """True if `score_rows` can compute the score, the log-likelihood's derivatives in the model's parameters.

        Only a `LinearFilter` can: a recursion over the rows carries the derivatives of its mean and covariance along.
        """
        return False

    def trace_log_likelihood(self, plain: Callable[..., jax.Array], z: Array, u: Array) -> jax.Array:
        """Return plain(self, z, u), the log-likelihood of rows, with derivatives also where covariances are zero."""
        return take_derivatives_from(plain, evaluate_for_derivatives(plain), (self, z, u))

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> "AbstractFilter":
        """Return the same filter for these inputs and complete data, with covariances and gains computed in advance."""
        return self

    def given_record(self) -> "AbstractFilter":
        """Return the filter with covariances given its data; only a linear filter behind random gains differs."""
        return self

    def with_past(self, steps: SmootherStep) -> "AbstractFilter":
        """Return a planned filter that can be smoothed, given the smoother `steps` of the original filter over time."""
        return self

    def for_single_precision(self) -> "AbstractFilter":
        """Return a filter of the same estimates whose mean keeps its digits in single precision; by default itself."""
        return self

    def with_room_for_heartbeats_of(self, others: Sequence["AbstractFilter"]) -> "AbstractFilter":
        """Return the same filter with arrays as long as the longest of the others, so that one program steps all."""
        return self

    def angles_used(self) -> FilterAngles | None:
        """Return which states and received numbers it takes for angles; None if it is not known."""
        return None

    @property
    def attitude(self) -> Angles:
        """Indices of states that are attitudes (rotation vectors): a correction rotates instead of adding."""
        return ()

    @property
    def assumed(self) -> AssumedModel | None:
        """Plant, sensor, channel and trigger under which the claim holds; None if the filter does not say."""
        return self.kept.assumed

    @property
    def of_atoms(self) -> bool:
        """True if the law of z is a mixture over points, so that likelihood 0 says that the model excludes z."""
        return False

    @property
    def silence_tells(self) -> bool:
        """True if a step without a message is data: its sender stays silent by a rule, so silence has a likelihood."""
        return False

    @property
    def horizon(self) -> int | None:
        """Number of steps that it covers; None if there is no last one."""
        return steps_covered(self)


class AbstractSizedFilter(AbstractFilter):
    """Filter that holds its claim and its sizes as fields."""

    claim: Claim = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    def angles_used(self) -> FilterAngles | None:
        """Return no angles; a filter whose models may have some overrides this, others refuse such models."""
        return FilterAngles((), ())


@compile_on_call
def step_with_judgement(
    filter: AbstractFilter, state: PyTree, z: PyTree, u: PyTree, k: PyTree
) -> tuple[PyTree, Estimate, Judgement, Innovation]:
    """Step a filter; return its state, the estimate, the judgement (are the data plausible?) and the innovation."""
    prior = filter.predict(state, u, k)
    after, innovation = filter.correct(prior, z, k)
    estimate = filter.after_step(after, k)
    estimates = filter.estimate(state), filter.estimate(prior), estimate
    spoilt = do_inputs_spoil(filter, filter.inputs, u, k)
    used = filter.angles_used()
    judgement = judge_step(filter.claim, (state, prior, after), estimates, innovation, z, filter.of_atoms, used, spoilt)
    return after, estimate, judgement, innovation


@compile_on_call
def _step_with_smoother(
    filter: AbstractFilter, state: PyTree, z: PyTree, u: PyTree, k: PyTree
) -> tuple[PyTree, SmootherStep]:
    """Predict and correct over one step; return the state, and what a backward pass needs of this step."""
    prior = filter.predict(state, u, k)
    after, innovation = filter.correct(prior, z, k)
    return after, make_smoother_step(filter, StepTrace(state, prior, after, innovation, z, u, k))


def predicts(predict: Callable[P, R]) -> Callable[P, R]:
    """Decorate a filter's `predict(state, u, k)`: its arguments are checked and made arrays, and it is compiled.

    Args:
        predict: the method of a filter, which gets arrays of the filter's sizes.
    """
    return _compile_with_checks(predict, AbstractFilter.check_input, call_with_inputs)


def corrects(correct: Callable[P, R]) -> Callable[P, R]:
    """Decorate a filter's `correct(state, z, k)`: its arguments are checked and made arrays, and it is compiled.

    Args:
        correct: the method of a filter, which gets arrays of the filter's sizes.
    """
    return _compile_with_checks(correct, AbstractFilter.check_measurement, call_with_state)


def estimates(estimate: Callable[P, R]) -> Callable[P, R]:
    """Decorate a filter's `estimate(state)`: it computes in double precision, and refuses a state of another form.

    Args:
        estimate: the method, a function of the filter and its state.
    """
    run = cast(Callable[..., R], in_float64(estimate))

    @wraps(estimate)
    def call(filter: AbstractFilter, state: PyTree) -> R:
        """Check the form of the state, and call the method."""
        return call_with_state(filter, state, run)

    return cast(Callable[P, R], call)


def _compile_with_checks(
    function: Callable[P, R],
    check: Callable[[AbstractFilter, ArrayLike], Float[Array, " length"]],
    call_checked: Callable[..., R],
) -> Callable[P, R]:
    """Return a filter's compiled method, which checks its data, its step number and the form of its state."""
    run = cast(Callable[..., R], compile_on_call(function))

    @wraps(function)
    def call(filter: AbstractFilter, state: PyTree, data: ArrayLike = (), k: Step = 0) -> R:
        """Check the data (z or u), the step number and the form of the state, and call the compiled method."""
        return call_checked(filter, state, run, check(filter, data), check_step_number(filter, k))

    return cast(Callable[P, R], call)


def check_step_number(filter: AbstractFilter, k: Step) -> Step:
    """Return k if it is the number of a step that the filter covers; raise ValueError if not."""
    if isinstance(k, jax.core.Tracer):
        return k  # inside a compiled computation it has no value to check
    is_scalar = isinstance(k, int | np.integer | np.ndarray | jax.Array) and not np.shape(k)
    if not is_scalar or not np.issubdtype(np.asarray(k).dtype, np.integer) or np.asarray(k) < 0:
        raise fail("step", "a whole number from 0", show_value(k))
    if filter.horizon is not None and np.asarray(k) >= filter.horizon:
        raise fail("step", f"one of the {filter.horizon} that the filter covers, counted from 0", k)
    return np.asarray(k)
