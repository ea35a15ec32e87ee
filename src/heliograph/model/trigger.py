"""Triggers: rules by which a sender transmits: by schedule, on change, on a prediction's error, or by chance."""

from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import TINY, array, check_count, covariance, fail, rank, scalar, show_value
from heliograph.numerics.domains import POSITIVE, report_domain
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int

Reference = Literal["sent", "acknowledged", "prediction", "zero"]
Region = Literal["box", "ball", "each"]
Losses = Literal["unknown", "numbered", "known"]
REFUSED = 2.0  # what is known of a value that came and is refused: behind z, in place of 1 for one that was lost


@readable
class SendReason:
    """Why a sender transmits; negative in a record where the transmission was lost, 0 where it sent nothing."""

    SILENT, EVENT, HEARTBEAT, FIRST, SCHEDULE = range(5)


class SenderState(NamedTuple):
    """State of a sender after a step, for each component of y.

    Shapes (m,) all: reference, what y is compared with; age, steps since the last transmission; begun, whether there is
    a reference; lost, transmissions lost since the last that arrived; last, the reason of this step.
    """

    reference: jax.Array
    age: jax.Array
    begun: jax.Array
    lost: jax.Array
    last: jax.Array


@readable
class AbstractTrigger(Module):
    """A sender's rule: at each step it transmits the measurement y, or nothing.

    Args:
        region: "box" and "ball" transmit all of y or nothing, "each" decides for each component alone.
        losses: knowledge of the receiver of a transmission that was lost: "unknown", none; "numbered", from the
            sequence number of the next value that arrives; "known", at once. It arrives behind z: how many were lost
            since the last value (with a value), or if one was lost now (0 or 1; 2: it came, and is refused).
        reference: what y is compared with: the value "sent" or "acknowledged" last, a "prediction" of both
            ends, or "zero".
        heartbeat: most steps between two transmissions, (); None where there is no such limit.
    """

    region: eqx.AbstractVar[Region]
    losses: eqx.AbstractVar[Losses]
    reference: eqx.AbstractVar[Reference]
    heartbeat: eqx.AbstractVar[Int[Array, ""] | None]

    @property
    def needs_reference(self) -> bool:
        """True if the first value has to be sent, since there is nothing yet to compare with."""
        return self.reference in ("sent", "acknowledged")

    def side_information(self, outputs: int) -> int:
        """Return how many numbers about lost transmissions arrive after z.

        There are none if the receiver does not learn of losses ("unknown"). Else there is one, or one for each of the
        `outputs` if components of y are sent in messages of their own (region "each").
        """
        if self.losses == "unknown":
            return 0
        return outputs if self.region == "each" else 1

    def leave_out_refused(
        self, z: Float[Array, "*rows received"], refused: Bool[Array, "*rows received"], outputs: int
    ) -> Float[Array, "*rows received"]:
        """Return what was received without the readings that are refused, although they were sent.

        A message of which no value is left was sent all the same: where losses are "known", REFUSED stands behind z;
        where they are "numbered", its number stays; where they are "unknown" it cannot be told from silence.

        z: what was received, the numbers about losses last; refused: which of it is; outputs: number of the sensor's.
        """
        xp = library(z)
        left: Array = xp.where(refused, np.nan, z)
        if self.losses != "known":
            return left
        count = z.shape[-1] - self.side_information(outputs)
        came, stays = ~xp.isnan(z[..., :count]), ~xp.isnan(left[..., :count])
        if self.region != "each":  # all values are one message
            came, stays = (mask.any(axis=-1, keepdims=True) for mask in (came, stays))
        numbers: Array = xp.where(came & ~stays, REFUSED, left[..., count:])
        with_numbers: Array = xp.concatenate([left[..., :count], numbers], axis=-1)
        return with_numbers

    def event(self, error: jax.Array, key: jax.Array, k: jax.Array) -> jax.Array:
        """Decide for each component whether error = y - reference, (m,), makes it be sent at step k."""
        raise unwritten(self, "event")

    def check_outputs(self, outputs: int) -> None:
        """Raise ValueError unless the rule's numbers fit so many components."""

    def start(self, outputs: int) -> SenderState:
        """Return a sender that has transmitted nothing yet."""
        zeros = jnp.zeros(outputs, dtype=int)
        # If y is compared with an earlier value, the sender has not begun before the first value is sent.
        begun = jnp.full(outputs, not self.needs_reference)
        return SenderState(jnp.zeros(outputs), zeros, begun, zeros, zeros)

    def reasons(self, sender: SenderState, y: jax.Array, key: jax.Array, k: jax.Array) -> jax.Array:
        """Return the reason for which each component of y is sent at step k, (m,), or 0 (SILENT) if it is not sent.

        The reason is FIRST without a reference yet, else EVENT if the rule says so, else HEARTBEAT if the last
        transmission is too old (`sender.age`: steps since then).
        """
        reason = jnp.where(self.event(y - sender.reference, key, k), self._event_reason(), SendReason.SILENT)
        if self.heartbeat is not None:
            due = sender.age + 1 >= self.heartbeat
            reason = jnp.where(due & (reason == SendReason.SILENT), SendReason.HEARTBEAT, reason)
        return jnp.where(sender.begun, reason, SendReason.FIRST)

    def _event_reason(self) -> int:
        """Return the reason (`SendReason`) that is recorded where the rule's event makes y be sent."""
        return SendReason.EVENT

    def after(self, sender: SenderState, y: jax.Array, reason: jax.Array, arrived: jax.Array) -> SenderState:
        """Return the state of the sender after a step.

        `lost` counts the transmissions lost since the last one that arrived. The reference is the value sent last, or
        the last one acknowledged. A reason is stored with a minus sign if the transmission was lost.

        Args:
            sender: the state before the step.
            y: the measurement (m,).
            reason: why each component is sent (m,), 0 if it is not.
            arrived: whether each component arrives if it is sent (m,).
        """
        sent = reason > 0
        arrived = arrived & sent
        is_lost = sent & ~arrived
        is_new_reference = arrived if self.reference == "acknowledged" else sent
        reference = jnp.where(is_new_reference, y, sender.reference) if self.needs_reference else sender.reference
        age = jnp.where(sent, 0, sender.age + 1)
        lost = jnp.where(arrived, 0, sender.lost + is_lost)
        signed_reason = jnp.where(is_lost, -reason, reason)
        return SenderState(reference, age, sender.begun | is_new_reference, lost, signed_reason)

    def receive_if_sent(
        self, sender: SenderState, y: jax.Array, z: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[SenderState, jax.Array]:
        """Return the sender after the step, and what the receiver gets: z with NaN where the rule does not send.

        After z come the numbers about lost transmissions, of length `side_information`, if the receiver learns of them.

        Args:
            sender: the sender before the step.
            y: the measurement (m,); the rule decides which components of it are sent.
            z: what the channel would deliver of y, NaN where it would lose it.
            key: random key, for rules that draw.
            k: number of the step.
        """
        reason, would_arrive = self.reasons(sender, y, key, k), ~jnp.isnan(z)  # a reason above 0: it is sent
        # In region "each" every component is a message of its own. Else all components are one message.
        has_messages_by_component = self.region == "each"
        arrived = would_arrive if has_messages_by_component else jnp.full(len(y), jnp.any(would_arrive))
        sent = reason > 0 if has_messages_by_component else jnp.any(reason > 0)
        numbers_about_losses = self.known_losses(sender, reason, arrived)
        received = jnp.concatenate([jnp.where(sent, z, jnp.nan), numbers_about_losses])
        return self.after(sender, y, reason, arrived), received

    def known_losses(self, sender: SenderState, reason: jax.Array, arrived: jax.Array) -> jax.Array:
        """Return the numbers about losses that arrive after z, from the sender before this step.

        If losses are "numbered", it is how many transmissions were lost since the last that arrived, or NaN if none
        arrives now. If "known", it is whether one was lost now. If "unknown", there are none. The shape is (m,) if
        components are sent one by one, else (1,).
        """
        sent = reason > 0
        if self.losses == "numbered":
            flags = jnp.where(arrived & sent, sender.lost.astype(float), jnp.nan)
        else:
            flags = (sent & ~arrived).astype(float)
        return flags[: self.side_information(len(flags))]


class AbstractThreshold(AbstractTrigger):
    """A rule that transmits where y - reference leaves a region of size delta."""

    delta: eqx.AbstractVar[Float[Array, "..."]]

    def event(self, error: jax.Array, key: jax.Array, k: jax.Array) -> jax.Array:
        """Return whether each component is sent (m,): whether error = y - reference is beyond delta.

        Region "each" judges each component by its own error. "box" sends all if any error is beyond delta. "ball" sends
        all if the length of the error vector is.
        """
        delta = jnp.asarray(self.delta)
        if self.region == "ball":
            return jnp.full(len(error), jnp.sum(error**2) > delta**2)
        beyond = jnp.abs(error) > delta
        return beyond if self.region == "each" else jnp.full(len(error), jnp.any(beyond))

    def check_outputs(self, outputs: int) -> None:
        """Raise ValueError unless delta is one number, or for a box one number for each component."""
        if np.ndim(self.delta) and (self.region == "ball" or np.shape(self.delta) != (outputs,)):
            expected = "one number" if self.region == "ball" else f"one number, or {outputs}"
            raise fail("delta of the trigger", expected, f"shape {np.shape(self.delta)}")


class SendOnDelta(AbstractThreshold):
    """Transmit y where it left the interval reference +- delta, and at the latest `heartbeat` steps after the last.

    The reference is the value transmitted last, whether or not it arrived ("sent"), or the one acknowledged last
    ("acknowledged"). The first value is always sent. region: with several components "box" transmits y where one of
    them left its interval, "ball" where |y - reference| > delta, "each" only the components that left theirs.
    losses: what the receiver knows of them, as `AbstractTrigger` says.

    Shapes: delta (), or (m,) of a box and of each.

    Raises:
        ValueError: a delta that is not positive, a heartbeat below 1, an unknown reference, region or kind of losses.
    Source: Miskowicz, Send-on-delta concept: an event-based data reporting strategy (2006).
    """

    delta: Float[Array, "..."]
    heartbeat: Int[Array, ""] | None
    reference: Reference = eqx.field(static=True)
    region: Region = eqx.field(static=True)
    losses: Losses = eqx.field(static=True)

    def __init__(
        self,
        delta: ArrayLike,
        heartbeat: int | None = None,
        reference: Literal["sent", "acknowledged"] = "sent",
        region: Region = "box",
        losses: Losses = "unknown",
    ):
        """Check and hold the threshold delta, and after how many silent steps y is sent anyway (None: never).

        y is compared with the value last sent or acknowledged, by a region of size delta: a box, a ball, or an interval
        for each component. `losses` is what the receiver knows of lost messages.
        """
        self.delta, self.region = read_threshold(delta), read_choice("region", region, Region)
        self.heartbeat = None if heartbeat is None else np.asarray(check_count("heartbeat", heartbeat))
        self.reference = read_choice("reference", reference, Literal["sent", "acknowledged"])
        self.losses = read_choice("losses", losses, Losses)


class SendOnPredictionError(AbstractThreshold):
    """Transmit y where it left the interval prediction +- delta; both ends compute the prediction.

    It is h(f(xhat)) of the filter at the node that is made with this trigger, so the sender has to know what arrived.
    region, losses and heartbeat as of `SendOnDelta`.

    Shapes: delta (), or (m,) of a box and of each.

    Raises:
        ValueError: as `SendOnDelta`.
    Source: Wu, Jia, Johansson and Shi, Event-based sensor data scheduling (2013).
    """

    delta: Float[Array, "..."]
    heartbeat: Int[Array, ""] | None
    region: Region = eqx.field(static=True)
    losses: Losses = eqx.field(static=True)
    reference: Reference = eqx.field(static=True)

    def __init__(
        self, delta: ArrayLike, heartbeat: int | None = None, region: Region = "box", losses: Losses = "unknown"
    ):
        """Check and hold the threshold delta, and after how many silent steps y is sent anyway (None: never).

        y is compared with its prediction; `region` and `losses` as of `SendOnDelta`.
        """
        self.delta, self.region = read_threshold(delta), read_choice("region", region, Region)
        self.heartbeat = None if heartbeat is None else np.asarray(check_count("heartbeat", heartbeat))
        self.losses, self.reference = read_choice("losses", losses, Losses), "prediction"


class StochasticTrigger(AbstractTrigger):
    """Transmit y with the probability 1 - exp(-(y - r)' W (y - r) / 2), W the weight, so that silence is Gaussian.

    r is 0, or with `reference` "prediction" what both ends expect, as of `SendOnPredictionError`. losses "known": the
    receiver knows at each step whether the link is up, so that silence and loss can be distinguished.

    Shapes: weight () or (m, m).

    Raises:
        ValueError: a weight that is no positive definite matrix, an unknown reference or kind of losses.
    Source: Han, Mo, Wu, Weerakkody, Sinopoli and Shi, Stochastic event-triggered sensor schedule for remote state
        estimation (2015).
    """

    weight: Float[Array, "..."]
    reference: Reference = eqx.field(static=True)
    losses: Losses = eqx.field(static=True)
    region: Region = eqx.field(static=True)
    heartbeat: None = eqx.field(static=True)

    def __init__(
        self,
        weight: ArrayLike,
        reference: Literal["zero", "prediction"] = "zero",
        losses: Literal["unknown", "known"] = "unknown",
    ):
        """Check and hold the weight W, and what y is compared with.

        y is sent with probability 1 - exp(-e' W e / 2), e = y - r: never where e is 0, nearly always where e is large
        by the metric W. All components are sent together, so that the region counts as "box", and there is no longest
        silence (heartbeat), since silence must depend on e alone to be Gaussian.

        Args:
            weight: W, a positive number (W = weight I) or a positive definite matrix (m, m).
            reference: "zero" for r = 0, or "prediction" for what both ends expect.
            losses: whether the receiver can tell a lost message from silence: "unknown" or "known".
        """
        self.weight = scalar("weight", weight, TINY) if rank("weight", weight) == 0 else covariance("weight", weight)
        if not is_traced(self.weight) and self.weight.ndim and np.linalg.eigvalsh(self.weight)[0] <= 0:
            raise fail("weight", "a positive definite matrix", show_value(self.weight.tolist()))
        self.reference = read_choice("reference", reference, Literal["zero", "prediction"])
        self.losses = read_choice("losses", losses, Literal["unknown", "known"])
        self.region, self.heartbeat = "box", None

    def matrix(self, outputs: int) -> jax.Array:
        """Return W as a matrix (m, m)."""
        weight = jnp.asarray(self.weight)
        return weight * jnp.eye(outputs) if weight.ndim == 0 else weight

    def event(self, error: jax.Array, key: jax.Array, k: jax.Array) -> jax.Array:
        """Return (m,) True with probability 1 - exp(-e' W e / 2), e = `error`, by one draw for all components."""
        probability_of_silence = jnp.exp(-error @ self.matrix(len(error)) @ error / 2)
        return jnp.full(len(error), jax.random.uniform(key, dtype=float) > probability_of_silence)

    def known_losses(self, sender: SenderState, reason: jax.Array, arrived: jax.Array) -> jax.Array:
        """Return 1 if the link is down, else 0, whether anything is sent or not.

        So the receiver can tell a lost transmission from none. That none was sent then has a Gaussian likelihood.
        """
        return (~arrived).astype(float)[: self.side_information(len(arrived))]

    def check_outputs(self, outputs: int) -> None:
        """Raise ValueError unless the weight of the squared error is one number or a matrix of so many components."""
        if np.ndim(self.weight) and len(self.weight) != outputs:
            expected = f"a number, or shape {(outputs, outputs)}"
            raise fail("weight of the trigger", expected, f"shape {self.weight.shape}")


class Periodic(AbstractTrigger):
    """Transmit y at the steps k = phase, phase + period, ...

    Raises:
        ValueError: a period that is no whole number from 1, a phase that is none from 0 to period - 1.
    """

    period: Int[Array, ""]
    phase: Int[Array, ""]
    reference: Reference = eqx.field(static=True)
    losses: Losses = eqx.field(static=True)
    region: Region = eqx.field(static=True)
    heartbeat: None = eqx.field(static=True)

    def __init__(self, period: int, phase: int = 0):
        """Check and hold period and phase; y is sent whatever its value is, so that the reference plays no part."""
        if check_count("phase", phase, 0) >= check_count("period", period):
            raise fail("phase", f"a whole number below the period {period}", phase)
        self.period, self.phase = np.asarray(period), np.asarray(phase)
        self.reference, self.losses, self.region, self.heartbeat = "zero", "unknown", "box", None

    def event(self, error: jax.Array, key: jax.Array, k: jax.Array) -> jax.Array:
        """Return (m,) whether y is sent at step k: k = phase modulo the period."""
        return jnp.full(len(error), k % self.period == self.phase)

    def _event_reason(self) -> int:
        """Return the reason of a transmission by schedule."""
        return SendReason.SCHEDULE


def read_threshold(delta: ArrayLike) -> Float[Array, "..."]:
    """Return a checked threshold delta as an array: one positive number, or one for each component."""
    report_domain("delta", delta, POSITIVE)
    checked: Array = scalar("delta", delta) if rank("delta", delta) == 0 else array("delta", delta, (None,))
    if not is_traced(checked) and not np.all(checked > 0):
        raise fail("delta", "a positive number, or one for each component", show_value(np.asarray(checked).tolist()))
    return checked


def read_choice(name: str, value: object, kinds: object) -> Any:
    """Return a value that is one of the words of a type, such as Literal["sent", "acknowledged"].

    Raises:
        ValueError: any other value.
    """
    words = get_args(kinds)
    if not isinstance(value, str) or value not in words:
        raise fail(name, f"one of {', '.join(words)}", show_value(value))
    return value
