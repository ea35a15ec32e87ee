"""Filter behind words with two Gaussians: given that the last word was right in its leading bits, or that not."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import join_columns, rounding_of
from heliograph.factors.factored_gaussian import (
    Gaussian,
    append_rows,
    impose_moments_of_combination,
    merge_mixture,
    moments_of_mixture,
    take_leading,
)
from heliograph.factors.repeated_measurements import triangularise_noise
from heliograph.filters.base import AbstractSizedFilter, FilterAngles, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.gaussian_prediction import (
    predict_gaussian,
    second_moments_at_start,
    smoother_step_by_transform,
)
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.filters.words.word_filter import ReceivedWords, WordFilter
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import at, first
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.types import ArrayLike, Float

LEADING = 3  # bits; two leave one lock-in in 20,000 runs at 5 % of bits flipped, one leaves half of all
SURE = 1e-10  # share of a word's probability below which that of its leading bits' being wrong is rounding


class Hypotheses(NamedTuple):
    """Two Gaussians of the state (2, n), and the probabilities (2,) that the last words were right, and not."""

    parts: Gaussian
    weights: Float[jax.Array, "2"]


class TwoHypothesesFilter(AbstractSizedFilter):
    """The law of the state as a mixture of two Gaussians, by whether the last words were right in their leading bits.

    A word that disagrees with the prior was flipped, or the prior is wrong, as after a flip that was believed. One
    Gaussian of these two far places forgets the less probable one: its tail there is less than any probability of a
    flip, and words from there look like flips on and on. Here either law is conditioned on either answer, with
    the moments of `WordFilter`, and laws of the same answer are merged by their moments, so that mean and covariance
    are those of the four. Of several words in a message, all are right or not.

    Args:
        base: the filter with one Gaussian, whose moments are used.
    """

    base: WordFilter

    def angles_used(self) -> FilterAngles:
        """Return the angles of its plant."""
        return self.base.angles_used()

    @property
    def of_atoms(self) -> bool:
        """Always True: a number that is no word is excluded."""
        return True

    @compile_on_call
    def init(self) -> Hypotheses:
        """Return the prior twice, the first with all of the probability."""
        start = self.base.init()
        return Hypotheses(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start), jnp.array([1.0, 0.0]))

    @predicts
    def predict(self, state: Hypotheses, u: ArrayLike = (), k: Step = 0) -> Hypotheses:
        """Predict the Gaussians of both hypotheses: that the last words were right in their leading bits, or not."""
        plant, initial_power = at(self.base.plant, k), second_moments_at_start(self.base.plant, self.base)
        u = jnp.asarray(u)
        predicted = jax.vmap(lambda x: predict_gaussian(plant, self.base.transform, x, u, initial_power))(state.parts)
        return state._replace(parts=predicted)

    @corrects
    def correct(self, state: Hypotheses, z: ArrayLike, k: Step = 0) -> tuple[Hypotheses, Innovation]:
        """Correct with the words that arrived, one component of y after another."""
        base, z, n = self.base, jnp.asarray(z), len(self.states)
        words = base.identify_received_words(z, at(base.links, k))

        def append_measured(x: Gaussian) -> Gaussian:
            """Return the joint law of the state x and the signal that is measured, under one hypothesis.

            A hypothesis says that the last words were right in their leading bits, or that they were not. `base` is the
            filter of one Gaussian, and k the step.
            """
            signal = base.predict_signal(x, k)
            noise = triangularise_noise(join_columns(signal.noise, rounding_of(signal.size)))
            return append_rows(x, signal.mean, signal.slopes, noise)

        joint = Hypotheses(jax.vmap(append_measured)(state.parts), state.weights)
        begun, total = jnp.asarray(False), jnp.zeros(())
        for i in range(len(base.low)):
            joint, mass = self._split_and_merge(joint, i, words, begun)
            total = total + jnp.where(words.present[i], jnp.log(mass), 0.0)
            begun = begun | words.present[i]
        total = jnp.where(words.are_words, total, -jnp.inf)
        after = joint._replace(parts=take_leading(joint.parts, n))
        # The innovation is about what was expected by both hypotheses together, before the words.
        signal = base.predict_signal(_merge_hypotheses(state), k)
        return after, base.compute_innovation(signal, words, z, at(base.numbers, k), total)

    @estimates
    def estimate(self, state: Hypotheses) -> Estimate:
        """Return the mean and covariance of the mixture."""
        mean, covariance = moments_of_mixture(state.parts.mean, state.parts.covariance, state.weights)
        return Estimate(wrap_angles(mean, first(self.base.plant).angles), covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of one Gaussian of the mixture's moments."""
        return smoother_step_by_transform(self.base, step.map_states(_merge_hypotheses), self.base)

    def _split_by_answer(self, hypothesis: Gaussian, i: int, words: ReceivedWords) -> tuple[Gaussian, jax.Array]:
        """Condition one hypothesis on word i, and on each answer to the question whether its leading bits are right.

        A hypothesis says that the last words were right, or that they were not. Returns the hypothesis given each
        answer (yes, no) (2, ...), and the probabilities of word and answer (2,). There are LEADING (3) leading bits. An
        answer with a share of the probability below SURE, 1e-10, counts as impossible. `row` is that of y_i in the root
        of the law of state and signal.
        """
        row = hypothesis.root[len(self.states) + i]
        prior = self.base.find_signal_prior(hypothesis, i)
        effect = self.base.condition_by_leading_bits(i, words, prior, LEADING)
        mass = jnp.exp(effect.log_mass)
        is_possible = (mass > SURE * jnp.sum(mass)) & (prior.deviation > 0)

        def impose(is_possible: jax.Array, shift: jax.Array, ratio: jax.Array) -> Gaussian:
            """Return the hypothesis with these moments of y_i, or unchanged if the answer is impossible."""
            shift, ratio = jnp.where(is_possible, shift, 0.0), jnp.where(is_possible, ratio, 1.0)
            return impose_moments_of_combination(hypothesis, row, shift * prior.deviation, jnp.maximum(ratio, 0.0))

        return jax.vmap(impose)(is_possible, effect.shift, effect.ratio), jnp.where(is_possible, mass, 0.0)

    def _split_and_merge(
        self, joint: Hypotheses, i: int, words: ReceivedWords, begun: jax.Array
    ) -> tuple[Hypotheses, jax.Array]:
        """Condition both hypotheses on word i and on whether it was right; merge the four by whether all words were.

        Args:
            joint: the two Gaussians of (x, y): all words of the message so far were right, or not.
            i: component of y.
            words: what was received.
            begun: whether another word of the message was used before.

        Returns:
            The hypotheses after word i, and the probability of what came; as they were, if it did not come.
        """
        # Four parts [h, a]: hypothesis h before the word; answer a to whether this word was right, 0 yes and 1 no.
        parts, mass = jax.lax.map(lambda part: self._split_by_answer(part, i, words), joint.parts)
        mass = mass * joint.weights[:, None]
        total = jnp.sum(mass)
        # All right: this word, and under the first hypothesis those before it. Before the first word of a message
        # either hypothesis is of the message before, and only this word counts.
        right = jnp.array([[True, False], [True, False]]) & jnp.stack([jnp.asarray(True), ~begun])[:, None]
        four_parts = jax.tree.map(lambda leaf: leaf.reshape(4, *leaf.shape[2:]), parts)

        def merge_chosen(chosen: jax.Array) -> tuple[Gaussian, jax.Array]:
            """Merge the chosen parts to one Gaussian, and return their probability; if they have none, merge all parts.

            There are four parts: two hypotheses on the words before, times two answers on this word. `mass` (2, 2)
            holds their probabilities, and `total` is the sum.
            """
            chosen_mass = jnp.where(chosen, mass, 0.0).ravel()
            probability = jnp.sum(chosen_mass)
            shares_if_none = jnp.where(total > 0, mass.ravel() / jnp.where(total > 0, total, 1.0), 0.25)
            chosen_shares = chosen_mass / jnp.where(probability > 0, probability, 1.0)
            shares = jnp.where(probability > 0, chosen_shares, shares_if_none)
            return merge_mixture(four_parts, shares), probability

        merged, weights = jax.vmap(merge_chosen)(jnp.stack([right, ~right]))
        used = words.present[i] & (total > 0)
        after = Hypotheses(merged, weights / jnp.where(total > 0, total, 1.0))
        return jax.tree.map(lambda new, old: jnp.where(used, new, old), after, joint), total


def _merge_hypotheses(state: Hypotheses) -> Gaussian:
    """Return one Gaussian of the mixture's mean and covariance."""
    return merge_mixture(*state)


def make_two_hypotheses_filter(base: WordFilter) -> TwoHypothesesFilter:
    """Return the filter of two hypotheses that uses the moments of one."""
    return TwoHypothesesFilter(base=base, **make_sizes(base.claim, first(base.plant), base.received))
