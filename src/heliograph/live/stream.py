"""One filter on live data: push a measurement, read the estimate."""

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.live.filter_stepper import RARE, compile_once, find_deciding_sender
from heliograph.live.health.sender_status import LossChain, SenderStatus, SilenceRule
from heliograph.live.health.stuck_sensor_watch import RepeatWatch
from heliograph.live.stored.old_layout import can_read_layout, describe_old_layout, relocate_parts
from heliograph.live.stored.snapshot import check_same_network, pack_snapshot, unpack_snapshot
from heliograph.model.checks.non_finite_results import describe_non_finite_function
from heliograph.model.checks.plant_inputs import check_inputs
from heliograph.model.checks.refusal_reasons import SCREENED, Reason, count_by_reason
from heliograph.model.estimate import JudgedEstimate, lower_unsound_claim, weakest
from heliograph.model.forecast_origin import Origin
from heliograph.model.readings.reading_limits import LimitsLike, ScreenedReadings, make_limits
from heliograph.model.readings.repeated_readings import Repeats, StuckLike
from heliograph.numerics.check import fail
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike
from heliograph.simulation.description.angle_doubts import WideAngles

COUNTED: tuple[Reason, ...] = (*SCREENED, "gate")
BEYOND = 10  # measurements in a row, each beyond what an honest filter sees with probability RARE
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
        """Start from the filter's initial law: no step is done, and nothing counted. The arguments are the class's."""
        if not isinstance(filter, AbstractFilter):
            raise fail("stream", "a filter", type(filter).__name__)
        # The sensor and the channel that the filter was made for, where it says so.
        self.filter, assumed = filter, filter.assumed
        sensor, channel = (None, None) if assumed is None else (assumed.sensor, assumed.channel)
        # Rules by which values are refused before the filter; by reason, how many were of each component (received,).
        self.limits = make_limits(filter.received, limits, invalid, stuck, sensor, channel)
        self.refused = {reason: np.zeros(filter.received, dtype=np.int64) for reason in COUNTED}
        # Runs of equal readings are watched (for a warning) where no rule refuses them, and where the sender does not
        # decide when to send: such a sender may well repeat a value.
        self._repeats = Repeats()
        refuses_stuck = self.limits is not None and self.limits.stuck is not None
        is_watched = not refuses_stuck and not find_deciding_sender(filter)
        self._watch = RepeatWatch.for_sensor(sensor, channel, filter.received) if is_watched else None
        self.steps = 0  # done so far
        self._last = -1  # the step of a sender's newest value
        self._beyond = 0  # unexpected measurements in a row
        self._remarked = 0  # remarks made of the filter's state
        self._inputs = np.full(len(filter.inputs), np.nan)  # of the newest step
        # The compiled step, which streams of a filter share, and this stream's own state; angles to warn of.
        self._compiled = compile_once(filter)
        self._stepper = self._compiled.make_stepper()
        self._angles = WideAngles(filter)

    @property
    def doubt(self) -> str:
        """Return a sentence if the last BEYOND (10) measurements or more were all unexpected, else "".

        An unexpected measurement is so far off that a right filter sees it with probability RARE.
        """
        if self._beyond < BEYOND:
            return ""
        return (
            f"the last {self._beyond} measurements were each further off than one in {1 / RARE:,.0f} should be: "
            f"{type(self.filter).__name__} is lost, or surer than it may be; one that leaves out what is far does not "
            "come back from a wrong start, and begins anew with a larger initial covariance, or gives in (Gate(after=))"
        )

    def push(self, measurement: ArrayLike, inputs: ArrayLike = ()) -> JudgedEstimate:
        """Advance one step: `inputs` led to this `measurement`; return the posterior estimate.

        The estimate also has `nis`, the normalised innovation squared e' S^-1 e of the measurement, `received`, how
        many numbers arrived, and of a filter that weighs measurements the `weight` of each.

        Args:
            measurement: received values, shape (received,); NaN where a component did not arrive.
            inputs: the plant's inputs, shape (inputs,); by default none.

        Raises:
            ValueError: a measurement or inputs of another size, infinite values, an input that is NaN, a step past the
                end of what varies over time, implausible values; the state stays unchanged.
        """
        compiled, stepper = self._compiled, self._stepper
        k = self.steps
        z, u = self._convert_sample(measurement, inputs)
        # Values beyond the limits, or repeated for too long, count as not arrived.
        screened = None if self.limits is None else self.limits.screen(z[None], self._repeats)
        if screened is not None:
            z = compiled.leave_out_refused(z, screened)
        if compiled.horizon is not None and k >= compiled.horizon:
            raise fail("step", f"one of the {compiled.horizon} that the filter covers, counted from 0", k)
        # The step itself; one that was flagged is either refused by an error or accepted.
        if not stepper.step(z, u, k):
            self._refuse_or_accept(z, u)
        self.steps, self._inputs = k + 1, u
        # Note the step if a value came of a sender that decides when to send: its silence counts from there.
        if compiled.values and not np.isnan(z[: compiled.values]).all():
            self._last = k
        # What was refused and what is unexpected are counted. What is to be said of readings, the filter's state and
        # angles comes last, when all is done: where warnings are errors, the step counts too.
        lines = self._count_readings(screened, z)
        if self.filter.remarks:
            lines += self._describe_remark()
        nis, arrived = stepper.judgement[:2].tolist()
        if arrived and not math.isnan(nis):
            lines += self._count_unexpected(nis > compiled.rare[int(arrived)])
        if self._angles.states or self._angles.received:
            lines += self._describe_angles(z, k)
        for line in lines:
            warnings.warn(f"stream, {line}", stacklevel=2)
        return self._make_estimate(nis, int(arrived))

    def _convert_sample(self, measurement: ArrayLike, inputs: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return a measurement (received,) and inputs (inputs,) as doubles, or raise ValueError.

        Arrays of doubles of the right size pass without a check, for speed: the compiled step refuses what is not
        finite. Everything else is checked and converted; so is a measurement if there are limits, which look at it
        before the step does.
        """
        z, u = _as_doubles(measurement, self._compiled.received), _as_doubles(inputs, self._compiled.given)
        if z is None or self.limits is not None:
            z = np.asarray(self.filter.check_measurement(measurement))
        if u is None:
            u = np.asarray(self.filter.check_input(inputs))
        return z, u

    def _make_estimate(self, nis: float, arrived: int) -> JudgedEstimate:
        """Return the estimate after the step just done, and count the components that the filter weighed by 0.

        `nis` is the measurement's normalised innovation squared, NaN if it has none. `arrived` is how many of its
        numbers arrived. `weight` has an entry for each component, 0 if the filter's gate left it out as too far off.
        """
        estimate: JudgedEstimate = self._compiled.estimate.unflatten([*self._stepper.estimate, nis, arrived])
        weight = self._stepper.weight  # empty if the filter does not weigh components
        if len(weight):
            estimate = replace(estimate, weight=weight)
            self.refused["gate"] += weight == 0
        # What limits refuse depends on the state, so that no claim stronger than "nominal" holds.
        if self.limits is not None and self.limits.bounded:
            estimate = replace(estimate, claim=weakest([estimate.claim, "nominal"]))
        return lower_unsound_claim(estimate) if math.isnan(nis) else estimate

    @property
    def origin(self) -> Origin:
        """Return the state after the last step, from which `hg.forecast` predicts.

        `spacing` is the time between steps, NaN if it is an input (dt). Time counts steps from 0.
        """
        state = self._compiled.state.unflatten([np.array(leaf) for leaf in self._stepper.state])
        time, spacing = float(self.steps - 1), float("nan") if "dt" in self.filter.inputs else 1.0
        return Origin(self.filter, state, self.steps, np.array(self._inputs), time, spacing)

    @property
    def held(self) -> np.ndarray:
        """Return by component how many runs of equal readings were longer than noise allows (not refused: a doubt)."""
        found = self._repeats.found or [0] * self.filter.received
        return np.array(found, dtype=np.int64)

    def _count_readings(self, screened: ScreenedReadings | None, z: np.ndarray) -> list[str]:
        """Count refused readings and runs of equal ones; return a line for each output found stuck for the first time.

        Lines come only from a watch (`_watch`), which is there if no limits refuse stuck readings. `screened`: which
        readings limits refused, and why; None without limits. `_repeats`: runs of equal readings.
        """
        if screened is not None:
            for reason, more in count_by_reason(screened.refused).items():
                self.refused[reason] += more
            self._repeats = screened.repeats
        # `found`: by component, how many runs so far were longer than noise allows; () before the first reading.
        found_before, watch = self._repeats.found, self._watch
        if watch is None:
            return []
        self._repeats = watch.extend_runs(z.tolist(), self._repeats)
        found = self._repeats.found if self._repeats.found != found_before else ()
        first_runs = [i for i, count in enumerate(found) if count == 1 and not (found_before and found_before[i])]
        said = [watch.describe_stuck_output(i, f"received number {i}", self._repeats) for i in first_runs]
        return [f"step {self.steps - 1}: {words}" for words in said]

    def _describe_remark(self) -> list[str]:
        """Return a line with the filter's remark on its state if it is new, such as that a gate gave in; else [].

        `remark.times` says how often the filter has made this remark so far, and `_remarked` how often before.
        """
        remark = self.filter.remark(self._compiled.state.unflatten(self._stepper.state))
        is_new = remark.times > self._remarked
        self._remarked = remark.times
        return [remark.words] if is_new else []

    def _describe_angles(self, z: np.ndarray, k: int) -> list[str]:
        """Return lines on angles known less well than the filter can use, and on received ones in degrees, once."""
        _mean, covariance, *_ = self._stepper.estimate
        wide = self._angles.said_of(np.diagonal(covariance)[None])  # of several states' variances, here of one
        in_degrees = self._angles.doubt_unit(z[None])
        return [f"step {k}: {line}" for _, line in (*wide, *in_degrees)]

    def _count_unexpected(self, beyond: bool) -> list[str]:
        """Count unexpected measurements in a row (`beyond`: this was one); return a line at the BEYOND-th."""
        self._beyond = self._beyond + 1 if beyond else 0
        return [f"step {self.steps - 1}: {self.doubt}"] if self._beyond == BEYOND else []

    def _refuse_or_accept(self, z: np.ndarray, u: np.ndarray) -> None:
        """Raise ValueError if the step's inputs u or measurement z are implausible; else accept the flagged step.

        The stepper has refused the step as implausible, and still has the state before it. Inputs are to blame unless
        inputs of zero would be implausible too: then the filter is, and the step is accepted.
        """
        # A step is also flagged for infinite measurements and inputs that are no numbers: these checks raise.
        self.filter.check_measurement(z)
        self.filter.check_input(u)
        stepper = self._stepper
        judgement = Judgement(*stepper.judgement.tolist())
        if len(u) and (why := Judgement.why_inputs(stepper.judgement[None])):
            check_inputs(self.filter.inputs, u[None], self.filter, self.steps)
            if self._are_zero_inputs_plausible():
                got = f"{u.tolist()}: {why}{self._name_faulty_function(u)}"
                raise fail(f"inputs of step {self.steps}", "plausible ones", got)
        if judgement.reason > 0:
            why = Judgement.describe(float(judgement.reason), float(judgement.distance)) + self._name_faulty_function(u)
            raise fail(f"measurement of step {self.steps}", "a plausible one", f"{z.tolist()}: {why}")
        # Step anew, since zeros may have been tried in between, and accept.
        stepper.step(z, u, self.steps)
        stepper.accept()

    def _are_zero_inputs_plausible(self) -> bool:
        """Return whether inputs of zero, without a measurement, are plausible in this step; the state stays."""
        stepper = self._stepper
        state_before = stepper.state
        stepper.step(np.full(self.filter.received, np.nan), np.zeros(len(self.filter.inputs)), self.steps)
        why_implausible = Judgement.why_inputs(stepper.judgement[None])
        stepper.set_state(state_before)
        return not why_implausible

    def _name_faulty_function(self, u: np.ndarray) -> str:
        """Return "; " and the function of the filter's model that is not finite for inputs u, or "" if none is."""
        before = self.filter.estimate(self._compiled.state.unflatten(self._stepper.state))
        fault = describe_non_finite_function(self.filter, before, u, self.steps)
        return f"; {fault}" if fault else ""

    def sender(self) -> SenderStatus:
        """Return the status of a sender that decides when to send: what its silence means by now.

        `_last` is the step of the newest measurement that arrived, negative before the first.

        Raises:
            ValueError: the filter was not made by `event_filter`.
        """
        sender = find_deciding_sender(self.filter)
        if sender is None:
            raise fail("filter of a stream", "one of event_filter, whose sender decides", type(self.filter).__name__)
        rule = SilenceRule(sender.trigger, LossChain.of_channel(sender.channel), timeout=None)
        last_arrival, now = None if self._last < 0 else self._last, self.steps - 1
        return rule.find_status(last_arrival, begun=-1, final=now, now=now)

    def save(self) -> bytes:
        """Return state, counts and newest inputs as bytes for `restore`: then the same pushes give the same bits."""
        leaves = {f"state.{i}": leaf for i, leaf in enumerate(self._stepper.state)}
        head = {
            "paths": list(self._compiled.layout),
            "steps": self.steps,
            "refused": {reason: count.tolist() for reason, count in self.refused.items()},
            "repeats": self._repeats,
            "last": self._last,  # step of the newest measurement
            "beyond": self._beyond,  # unexpected measurements in a row
            # JSON has no NaN: an input that is not known is None.
            "inputs": [None if value != value else value for value in self._inputs.tolist()],
            "of": self._compiled.identity,  # of the filter: `restore` refuses another one
        }
        return pack_snapshot(head, leaves)

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
        identity_saved = head.get("of", {})
        check_same_network("snapshot", new._compiled.identity, identity_saved, SAME, accept_changes)
        new._restore_counts(head)
        new._stepper.set_state(_read_state(head, arrays, new._compiled.layout, identity_saved.get("filter", "")))
        # Remarks on this state were made before it was saved.
        new._remarked = filter.remark(new._compiled.state.unflatten(new._stepper.state)).times
        return new

    def _restore_counts(self, head: dict[str, Any]) -> None:
        """Set the step number, the newest inputs and all counts to those in the head of a snapshot.

        Earlier versions did not write all of them; the rest begins anew. `_beyond`: unexpected measurements in a row.
        """
        self.steps = int(head["steps"])
        # Versions up to 0.4.0 counted refusals by limits and by codes together.
        counted = head.get("refused") or {"limits": head["dropped"]}
        self.refused |= {reason: np.array(counts, dtype=np.int64) for reason, counts in counted.items()}
        self._repeats = Repeats(*map(tuple, head.get("repeats", ())))
        self._last, self._beyond = int(head.get("last", -1)), int(head.get("beyond", 0))
        inputs = head.get("inputs", [None] * len(self.filter.inputs))
        self._inputs = np.array([np.nan if value is None else value for value in inputs], dtype=float)

    def __getstate__(self) -> dict[str, object]:
        """Return filter, step number and state, in double precision; compiled programs are left out."""
        data = {name: value for name, value in vars(self).items() if name not in ("_compiled", "_stepper")}
        return data | {"state": self._stepper.state}

    def __setstate__(self, data: dict[str, Any]) -> None:
        """Restore what `__getstate__` returned, and compile the step anew."""
        state = data["state"]
        vars(self).update({name: value for name, value in data.items() if name != "state"})
        self._compiled = compile_once(self.filter)
        self._stepper = self._compiled.make_stepper()
        self._stepper.set_state(state)


def _read_state(
    head: dict[str, Any], arrays: dict[str, np.ndarray], layout: dict[str, tuple[int, ...]], filter_name: str
) -> list[np.ndarray]:
    """Return the parts of a filter's state, in the order of its `layout`, from a snapshot.

    Args:
        head: the snapshot's head; its "paths" name the stored parts, in their order.
        arrays: its arrays, of which "state.0", "state.1", ... are these parts.
        layout: {path of a part: its shape} of the filter as it is here.
        filter_name: the filter's class, for errors.

    Raises:
        ValueError: the parts cannot be read as those of this layout.
    """
    # A version before 0.3.0 wrote no paths: its parts are those of its layout.
    paths = head.get("paths", list(describe_old_layout(layout)))
    parts = [arrays[f"state.{i}"] for i in range(sum(name.startswith("state.") for name in arrays))]
    stored = dict(zip(paths, parts, strict=False))
    if len(paths) != len(parts) or not can_read_layout({path: part.shape for path, part in stored.items()}, layout):
        expected = f"a state with the parts of {filter_name} as it is here: {', '.join(layout)}"
        raise fail("snapshot", expected, ", ".join(f"{path} {list(part.shape)}" for path, part in stored.items()))
    return list(relocate_parts(stored, layout).values())


def _as_doubles(value: object, length: int) -> np.ndarray | None:
    """Return an array or list of `length` doubles as an array, or None for anything else, which is checked slowly."""
    if type(value) is not np.ndarray and (type(value) is not list or any(part is np.ma.masked for part in value)):
        return None
    try:
        row = np.asarray(value)
    except (TypeError, ValueError, OverflowError):  # rows of different lengths; traced numbers
        return None
    return row if row.shape == (length,) and row.dtype.char == "d" else None
