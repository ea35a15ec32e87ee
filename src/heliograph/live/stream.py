"""One filter on live data: push a measurement, read the estimate."""

import warnings
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import chi2

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.live.filter_stepper import NativeFilterStepper, XlaFilterStepper, compile_native_step, compile_xla_step
from heliograph.live.repeat_watch import RepeatWatch
from heliograph.live.sender_status import LossChain, SenderStatus, SilenceRule
from heliograph.live.stored.old_layout import can_read_layout, describe_old_layout, relocate_parts, split_by_path
from heliograph.live.stored.snapshot import Identity, check_same_network, pack, unpack_snapshot, versions
from heliograph.model.channel import Channel
from heliograph.model.checks.faults import find_function_fault
from heliograph.model.checks.inputs import check_inputs
from heliograph.model.checks.refusals import SCREENED, Reason, count_by_reason
from heliograph.model.estimate import JudgedEstimate, lower_unsound_claim, weakest
from heliograph.model.forecast_origin import Origin
from heliograph.model.limits import LimitsLike, ScreenedReadings, make_limits
from heliograph.model.over_time import first
from heliograph.model.repeated_readings import Repeats, StuckLike
from heliograph.model.trigger import AbstractTrigger
from heliograph.numerics.caching import share_by_object
from heliograph.numerics.check import fail
from heliograph.numerics.module import readable
from heliograph.numerics.trees.program_text import hash_numbers, text_of
from heliograph.numerics.trees.static import cast
from heliograph.numerics.types import ArrayLike, PyTree
from heliograph.simulation.description.wide_angles import WideAngles

COUNTED: tuple[Reason, ...] = (*SCREENED, "gate")
BEYOND, RARE = 10, 1e-4  # measurements in a row, each beyond what an honest filter sees so seldom
SAME = ("precision", "filter", "states", "inputs", "numbers received")  # what the state of a stream means


@readable
class Stream:
    """One filter fed one sample at a time, from one thread; the stream holds its state and step number.

    The numbers agree with those of `run` over the same data up to rounding: the compiler orders and joins the
    operations of a step as the surrounding program allows. Native code computes the steps, or XLA where native code
    does not support the filter. Measurements that would spoil the state are refused (`push`).

    Args:
        filter: the filter to run.
        limits: greatest and smallest plausible values, as of a `Node`; numbers beyond them count as not arrived. What
            is refused then depends on the state: the claim is nominal.
        invalid: codes for a missing value, as of a `Node`.
        stuck: after how many equal readings in a row one counts as not arrived, as of a `Node`.

    `refused` counts by reason and component what is refused: "limits", "code" and "stuck" before the filter, "gate"
    by it alone, with a weight of 0.
    A filter that was sure of a wrong start, behind a gate, leaves out all that comes: where BEYOND measurements in a
    row are further off than one in 10,000 should be, a warning says so, and `doubt` until one is not. An angle that is
    known less well than the filter can use is warned of once.

    Raises:
        ValueError: no filter, or invalid limits.
    """

    def __init__(
        self,
        filter: AbstractFilter,
        limits: LimitsLike = None,
        invalid: ArrayLike = (),
        stuck: StuckLike = None,
    ):
        if not isinstance(filter, AbstractFilter):
            raise fail("stream", "a filter", type(filter).__name__)
        self.filter, world = filter, filter.premise
        believed = (None, None) if world is None else (world.sensor, world.channel)
        self.limits = make_limits(filter.received, limits, invalid, stuck, *believed)
        self.refused = {reason: np.zeros(filter.received, dtype=np.int64) for reason in COUNTED}
        self._repeats = Repeats()
        refuses = self.limits is not None and self.limits.stuck is not None
        self._watch = None if refuses or _sender_of(filter) else RepeatWatch.of(*believed, filter.received)
        # Steps done; step of a sender's newest value; unexpected measurements in a row; remarks made.
        self.steps, self._last, self._beyond, self._remarked = 0, -1, 0, 0
        self._inputs = np.full(len(filter.inputs), np.nan)
        self._compiled, self._angles = _compile_once(filter), WideAngles(filter)
        self._stepper = self._compiled.stepper()

    @property
    def doubt(self) -> str:
        """Return a sentence where the last BEYOND measurements, or more, were all unexpected; else ""."""
        if self._beyond < BEYOND:
            return ""
        return (
            f"the last {self._beyond} measurements were each further off than one in {1 / RARE:,.0f} should be: "
            f"{type(self.filter).__name__} is lost, or surer than it may be; one that leaves out what is far does not "
            "come back from a wrong start, and begins anew with a larger initial covariance, or gives in (Gate(after=))"
        )

    def push(self, measurement: ArrayLike, inputs: ArrayLike = ()) -> JudgedEstimate:
        """Advance one step: `inputs` led to this `measurement`; return the posterior estimate.

        It has the normalised innovation squared of the measurement, `nis`, how many numbers arrived, `received`, and of
        a filter that weighs them the `weight` of each.

        Args:
            measurement: received values, shape (received,); NaN where a component did not arrive.
            inputs: the plant's inputs, shape (inputs,); by default none.

        Raises:
            ValueError: a measurement or inputs of another size, infinite values, an input that is NaN, a step past the
                end of what varies over time, implausible values; the state stays unchanged.
        """
        compiled, k, stepper = self._compiled, self.steps, self._stepper
        # Arrays of doubles of the right size pass at once; everything else is checked and converted.
        z, screened = _as_doubles(measurement, compiled.received), None
        if z is None or self.limits is not None:
            z = np.asarray(self.filter.check_measurement(measurement))
        u = _as_doubles(inputs, compiled.given)
        if u is None:
            u = np.asarray(self.filter.check_input(inputs))
        if self.limits is not None:
            # Values beyond the limits, or repeated for too long, count as not arrived.
            screened = self.limits.screen(z[None], self._repeats)
            z = screened.values[0]
        if compiled.horizon is not None and k >= compiled.horizon:
            raise fail("step", f"one of the {compiled.horizon} that the filter covers, counted from 0", k)
        # The step itself; one that was flagged is either refused by an error or accepted.
        if not stepper.step(z, u, k):
            self._refuse_or_accept(z, u)
        self.steps, self._inputs = k + 1, u
        if compiled.values and not np.isnan(z[: compiled.values]).all():
            self._last = k
        self._count_readings(screened, z)
        if self.filter.remarks:
            self._warn_of_remark()
        # Count in how many steps in a row nis was over its quantile.
        nis, arrived = stepper.judgement[:2].tolist()
        has_nis = nis == nis  # NaN if not
        if arrived and has_nis:
            self._count_unexpected(nis > compiled.rare[int(arrived)])
        if self._angles.states or self._angles.received:
            self._warn_of_angles(z, k)
        estimate: JudgedEstimate = compiled.estimate.unflatten([*stepper.estimate, nis, int(arrived)])
        if len(weight := stepper.weight):
            estimate = replace(estimate, weight=weight)
            self.refused["gate"] += weight == 0
        if self.limits is not None and self.limits.bounded:
            estimate = replace(estimate, claim=weakest([estimate.claim, "nominal"]))
        return estimate if has_nis else lower_unsound_claim(estimate)

    @property
    def origin(self) -> Origin:
        """Return the state after the last step, from which `hg.forecast` predicts."""
        state = self._compiled.state.unflatten([np.array(leaf) for leaf in self._stepper.state])
        time, spacing = float(self.steps - 1), float("nan") if "dt" in self.filter.inputs else 1.0
        return Origin(self.filter, state, self.steps, np.array(self._inputs), time, spacing)

    @property
    def held(self) -> np.ndarray:
        """Return by component how many runs of equal readings were longer than its noise allows; none was refused."""
        found = self._repeats.found or [0] * self.filter.received
        return np.array(found, dtype=np.int64)

    def _count_readings(self, screened: ScreenedReadings | None, z: np.ndarray) -> None:
        """Count what was screened; where none is stuck by rule, warn of the first run of each component that is."""
        if screened is not None:
            for reason, more in count_by_reason(screened.refused).items():
                self.refused[reason] += more
            self._repeats = screened.repeats
        before, watch = self._repeats.found, self._watch
        if watch is None:
            return
        self._repeats = watch.follow(z.tolist(), self._repeats)
        for i, count in enumerate(self._repeats.found if self._repeats.found != before else ()):
            if count == 1 and not (before and before[i]):
                said = watch.describe(i, f"received number {i}", self._repeats)
                warnings.warn(f"stream, step {self.steps - 1}: {said}", stacklevel=3)

    def _warn_of_remark(self) -> None:
        """Warn of what the filter says of its state, such as that a gate gave in, where it is new."""
        said = self.filter.remark(self._compiled.state.unflatten(self._stepper.state))
        if said.times > self._remarked:
            warnings.warn(f"stream, {said.words}", stacklevel=3)
        self._remarked = said.times

    def _warn_of_angles(self, z: np.ndarray, k: int) -> None:
        """Warn of angles that are known less well than the filter can use, and of received ones in degrees, once."""
        wide = self._angles.said_of(np.diagonal(self._stepper.estimate[1])[None])
        for _, line in (*wide, *self._angles.doubt_unit(z[None])):
            warnings.warn(f"stream, step {k}: {line}", stacklevel=3)

    def _count_unexpected(self, beyond: bool) -> None:
        """Count unexpected measurements in a row (`beyond`: this was one), and warn at the BEYOND-th."""
        self._beyond = self._beyond + 1 if beyond else 0
        if self._beyond == BEYOND:
            warnings.warn(f"stream, step {self.steps - 1}: {self.doubt}", stacklevel=3)

    def _refuse_or_accept(self, z: np.ndarray, u: np.ndarray) -> None:
        """Raise ValueError at implausible values; accept the flagged step where only the filter is to blame."""
        self.filter.check_measurement(z)
        self.filter.check_input(u)
        stepper, (distance, _, reason, _) = self._stepper, self._stepper.judgement.tolist()
        if len(u) and (why := Judgement.why_inputs(stepper.judgement[None])):
            check_inputs(self.filter.inputs, u[None], self.filter, self.steps)
            # Are inputs of zero implausible too? Then it is not the inputs that are wrong.
            state = stepper.state
            stepper.step(np.full(len(z), np.nan), np.zeros(len(u)), self.steps)
            why_zeros = Judgement.why_inputs(stepper.judgement[None])
            stepper.set_state(state)
            if not why_zeros:
                raise fail(
                    f"inputs of step {self.steps}",
                    "plausible ones",
                    f"{u.tolist()}: {why}{self._name_faulty_function(u)}",
                )
        if reason > 0:
            why = Judgement.describe(reason, distance) + self._name_faulty_function(u)
            raise fail(f"measurement of step {self.steps}", "a plausible one", f"{z.tolist()}: {why}")
        stepper.step(z, u, self.steps)  # anew, since zeros may have been tried in between
        stepper.accept()

    def _name_faulty_function(self, u: np.ndarray) -> str:
        """Name the function of the filter's model that returned no number, after a semicolon; "" where none did."""
        before = self.filter.estimate(self._compiled.state.unflatten(self._stepper.state))
        fault = find_function_fault(self.filter, before, u, self.steps)
        return f"; {fault}" if fault else ""

    def sender(self) -> SenderStatus:
        """Return the status of a sender that decides when to send: what its silence means by now.

        Raises:
            ValueError: a filter that is none of `event_filter`.
        """
        if (sender := _sender_of(self.filter)) is None:
            raise fail("filter of a stream", "one of event_filter, whose sender decides", type(self.filter).__name__)
        last, now = None if self._last < 0 else self._last, self.steps - 1
        return SilenceRule(sender.trigger, LossChain.of_channel(sender.channel), None).status(last, -1, now, now)

    def save(self) -> bytes:
        """Return state and step number for `restore`: after it, the same pushes give the same bits."""
        leaves = {f"state.{i}": leaf for i, leaf in enumerate(self._stepper.state)}
        head = {
            "paths": list(self._compiled.layout),
            "steps": self.steps,
            "refused": {reason: count.tolist() for reason, count in self.refused.items()},
            "repeats": self._repeats,
            "last": self._last,
            "beyond": self._beyond,
            "inputs": [None if value != value else value for value in self._inputs.tolist()],
            "of": self._compiled.identity,
        }
        return pack(head, leaves)

    @classmethod
    def restore(
        cls,
        filter: AbstractFilter,
        data: bytes,
        limits: LimitsLike = None,
        invalid: ArrayLike = (),
        accept_changes: bool = False,
        stuck: StuckLike = None,
    ) -> "Stream":
        """Restore a saved stream of the same filter; `limits`, `invalid` and `stuck` hold from here on.

        Args:
            filter: the filter of the stream.
            data: what `save` returned.
            limits: bounds of plausible values, as for a new stream.
            invalid: values that mean that nothing was measured, as for a new stream.
            accept_changes: go on with a filter of other numbers, or that another version saved, if its state has the
                same parts; a covariance of a version before 0.3.0 becomes its factors.
            stuck: after how many equal readings one counts as not arrived, as for a new stream.

        Raises:
            ValueError: no snapshot, or one of another filter or version.
        """
        new, (head, arrays) = cls(filter, limits, invalid, stuck), unpack_snapshot(data)
        mine, other = new._compiled.identity, head.get("of", {})
        check_same_network("snapshot", mine, other, SAME, accept_changes)
        new.steps = int(head["steps"])
        # Until version 0.4.0 limits and codes together.
        counted = head.get("refused") or {"limits": head["dropped"]}
        new.refused |= {reason: np.array(counts, dtype=np.int64) for reason, counts in counted.items()}
        new._repeats = Repeats(*map(tuple, head.get("repeats", ())))
        new._last, new._beyond = int(head.get("last", -1)), int(head.get("beyond", 0))
        held = head.get("inputs", [None] * len(filter.inputs))
        new._inputs = np.array([np.nan if value is None else value for value in held], dtype=float)
        # Parts by their paths, which a version before 0.3.0 did not write.
        layout = new._compiled.layout
        paths = head.get("paths", list(describe_old_layout(layout)))
        leaves = [arrays[f"state.{i}"] for i in range(sum(name.startswith("state.") for name in arrays))]
        old = dict(zip(paths, leaves, strict=False))
        if len(paths) != len(leaves) or not can_read_layout({path: leaf.shape for path, leaf in old.items()}, layout):
            expected = f"a state with the parts of {other['filter']} as it is here: {', '.join(layout)}"
            raise fail("snapshot", expected, ", ".join(f"{path} {list(leaf.shape)}" for path, leaf in old.items()))
        new._stepper.set_state(list(relocate_parts(old, layout).values()))
        new._remarked = filter.remark(new._compiled.state.unflatten(new._stepper.state)).times
        return new

    def __getstate__(self) -> dict[str, object]:
        """Return filter, step number and state, in double precision; compiled programs are left out."""
        data = {name: value for name, value in vars(self).items() if name not in ("_compiled", "_stepper")}
        return data | {"state": self._stepper.state}

    def __setstate__(self, data: dict[str, Any]) -> None:
        state = data["state"]
        vars(self).update({name: value for name, value in data.items() if name != "state"})
        self._compiled = _compile_once(self.filter)
        self._stepper = self._compiled.stepper()
        self._stepper.set_state(state)


class _Sender(NamedTuple):
    """A sender that decides when to send, as its filter believes it: its rule, its link, its number of outputs."""

    trigger: AbstractTrigger
    channel: Channel
    outputs: int


def _sender_of(filter: AbstractFilter) -> _Sender | None:
    """Return the sender of which a filter knows what its silence means; None of any other filter."""
    world = filter.premise
    if not filter.silence_tells or world is None or world.trigger is None:
        return None
    assert world.sensor is not None and world.channel is not None  # a sender has both
    return _Sender(world.trigger, world.channel, len(first(world.sensor).outputs))


def _as_doubles(value: object, length: int) -> np.ndarray | None:
    """Return an array or list as `length` doubles; None for anything else, which needs a slower check."""
    if type(value) is not np.ndarray and (type(value) is not list or any(part is np.ma.masked for part in value)):
        return None
    try:
        row = np.asarray(value)
    except (TypeError, ValueError, OverflowError):  # rows of different lengths; traced numbers
        return None
    return row if row.shape == (length,) and row.dtype.char == "d" else None


class _CompiledFilter:
    """A compiled filter with its arrays, shared by all streams of the filter."""

    def __init__(self, filter: AbstractFilter):
        self.filter, self.horizon = filter, filter.horizon
        self.received, self.given = filter.received, len(filter.inputs)
        # How many of the received numbers are values of a sender that decides when to send; its losses follow them.
        self.values = 0
        if sender := _sender_of(filter):
            self.values = filter.received - sender.trigger.side_information(sender.outputs)
        with jax.enable_x64(True):
            self.numbers, self._static = cast(filter)
            self._start: PyTree = jax.device_put(jax.tree.map(np.asarray, filter.init()))  # no program for each shape
        self.state: PyTree = jax.tree.structure(self._start)
        self.layout = {path: part.shape for path, part in split_by_path(self._start).items()}
        self._data = np.zeros(self.received), np.zeros(self.given), np.asarray(0)
        with jax.enable_x64(True):
            modes = jax.eval_shape(filter.estimate, self._start).modes
        self.estimate: PyTree = jax.tree.structure(
            JudgedEstimate(np.zeros(()), np.zeros(()), filter.claim, modes, filter.attitude, 0.0, 0)
        )
        # By count of numbers that arrived: what their nis exceeds with probability RARE, as chi-square with so many.
        self.rare = [np.inf, *(float(chi2.isf(RARE, count)) for count in range(1, self.received + 1))]

    def stepper(self) -> NativeFilterStepper | XlaFilterStepper:
        """Return a new stepper whose state is the prior."""
        code = compile_native_step(self._static, self.numbers, self._start, self._data)
        if code is None:
            return XlaFilterStepper(compile_xla_step(self._static), self.numbers, self._start)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(self._start)]
        return NativeFilterStepper(code, [np.asarray(leaf) for leaf in self.numbers], leaves)

    @cached_property
    def identity(self) -> Identity:
        """Return versions, names, numbers and a hash of the step's program, whichever engine runs it."""
        with jax.enable_x64(True):
            text = text_of(compile_xla_step(self._static).trace(self.numbers, self._start, *self._data).jaxpr)
        filter = self.filter
        return {
            **versions(),
            "precision": ", ".join(sorted({str(leaf.dtype) for leaf in self.numbers})),
            "filter": type(filter).__name__,
            "states": ", ".join(filter.states),
            "inputs": ", ".join(filter.inputs),
            "numbers received": str(filter.received),
            "numbers": hash_numbers(self.numbers),
            "what is computed": hash_numbers(text),
        }


_compile_once = share_by_object(_CompiledFilter)  # returns a filter's compiled program, made at the first call
