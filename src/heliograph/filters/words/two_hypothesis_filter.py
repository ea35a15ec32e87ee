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
    """The law of the state as a mixture of two Gaussians (2, n) with probabilities (2,).

    The first is the law if the leading bits of the last message's codewords were all right, the second if they were
    not.
    """

    parts: Gaussian
    weights: Float[jax.Array, "2"]


class TwoHypothesesFilter(AbstractSizedFilter):
    """The law of the state as two Gaussians: the last message's codewords were right in their leading bits, or not.

    A codeword far from the prior had a bit flipped, or the prior is wrong, as after a flip that was taken for true. One
    Gaussian would forget the less probable place: its tail there is smaller than the probability of a flip, so that all
    later codewords from there look flipped. Here each Gaussian is conditioned on a codeword with its leading bits
    right, and with them not right. Of these four the two of the same answer are merged by their moments, which leaves
    the mean and covariance of the whole. "Right" stands for all codewords of a message.

    Args:
        base: the filter with one Gaussian, whose moments are used.
    """

    base: WordFilter

    def angles_used(self) -> FilterAngles:
        """Return the indices of states that are angles, as the filter with one Gaussian has them."""
        return self.base.angles_used()

    @property
    def of_atoms(self) -> bool:
        """Always True: codewords are finitely many or discrete, so likelihood 0 says that the model excludes z."""
        return True

    @compile_on_call
    def init(self) -> Hypotheses:
        """Return the prior as both Gaussians, the first with all of the probability: no codeword came yet."""
        start = self.base.init()
        return Hypotheses(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start), jnp.array([1.0, 0.0]))

    @predicts
    def predict(self, state: Hypotheses, u: ArrayLike = (), k: Step = 0) -> Hypotheses:
        """Predict the Gaussians of both hypotheses: the last message's leading bits were all right, or not.

        The hypotheses keep their probabilities.
        """
        plant, initial_power = at(self.base.plant, k), second_moments_at_start(self.base.plant, self.base)
        u = jnp.asarray(u)
        predicted = jax.vmap(lambda x: predict_gaussian(plant, self.base.transform, x, u, initial_power))(state.parts)
        return state._replace(parts=predicted)

    @corrects
    def correct(self, state: Hypotheses, z: ArrayLike, k: Step = 0) -> tuple[Hypotheses, Innovation]:
        """Correct with the codewords that arrived, one component of y after another.

        A codeword is a value rounded to a number of some bits; the link may have flipped some. The state is two
        Gaussians: the leading bits of the last codewords were right, or not. Each codeword splits both hypotheses, by
        whether its leading bits are right, and the four Gaussians are merged to two.
        """
        # `words`: which codeword of each component arrived, and for each of its bits P(received | 0 or 1 was sent).
        base, z, n = self.base, jnp.asarray(z), len(self.states)
        words = base.identify_received_words(z, at(base.links, k))

        def append_measured(x: Gaussian) -> Gaussian:
            """Return the joint Gaussian of the state x and the signal that is measured, under one hypothesis."""
            signal = base.predict_signal(x, k)
            noise = triangularise_noise(join_columns(signal.noise, rounding_of(signal.size)))
            return append_rows(x, signal.mean, signal.slopes, noise)

        # Both hypotheses over (x, y); then component after component, each with its probability given those before it.
        joint = Hypotheses(jax.vmap(append_measured)(state.parts), state.weights)
        some_word_was_used, log_likelihood = jnp.asarray(False), jnp.zeros(())
        for i in range(len(base.low)):
            joint, probability = self._split_and_merge(joint, i, words, some_word_was_used)
            log_likelihood = log_likelihood + jnp.where(words.present[i], jnp.log(probability), 0.0)
            some_word_was_used = some_word_was_used | words.present[i]
        # A received number that is no codeword is impossible.
        log_likelihood = jnp.where(words.are_words, log_likelihood, -jnp.inf)
        corrected = joint._replace(parts=take_leading(joint.parts, n))
        # The innovation is z less what both hypotheses together expected.
        signal = base.predict_signal(_merge_hypotheses(state), k)
        return corrected, base.compute_innovation(signal, words, z, at(base.numbers, k), log_likelihood)

    @estimates
    def estimate(self, state: Hypotheses) -> Estimate:
        """Return the mean and covariance of the mixture of both Gaussians, angles between -pi and pi."""
        mean, covariance = moments_of_mixture(state.parts.mean, state.parts.covariance, state.weights)
        return Estimate(wrap_angles(mean, first(self.base.plant).angles), covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return what a backward pass needs of a step, with both Gaussians merged to one before and after it."""
        return smoother_step_by_transform(self.base, step.map_states(_merge_hypotheses), self.base)

    def _split_by_answer(self, hypothesis: Gaussian, i: int, words: ReceivedWords) -> tuple[Gaussian, jax.Array]:
        """Condition one Gaussian of (x, y) on codeword i in two cases: its LEADING (3) highest bits are right, or not.

        Returns the Gaussians in both cases (2, ...), and the probabilities of codeword and case (2,).
        """
        row = hypothesis.root[len(self.states) + i]  # y_i = prior.mean + row xi
        prior = self.base.find_signal_prior(hypothesis, i)
        # log P(codeword, case), and for y_i = mean + deviation t: E t, and Var y_i over its prior variance.
        effect = self.base.condition_by_leading_bits(i, words, prior, LEADING)
        probability = jnp.exp(effect.log_mass)
        # A difference of sums may be mere rounding: a case with less than SURE of the probability is impossible.
        is_possible = (probability > SURE * jnp.sum(probability)) & (prior.deviation > 0)

        def impose(is_possible: jax.Array, shift: jax.Array, ratio: jax.Array) -> Gaussian:
            """Return the Gaussian in which y_i has the moments of one case, or unchanged if the case is impossible."""
            shift, ratio = jnp.where(is_possible, shift, 0.0), jnp.where(is_possible, ratio, 1.0)
            return impose_moments_of_combination(hypothesis, row, shift * prior.deviation, jnp.maximum(ratio, 0.0))

        conditioned = jax.vmap(impose)(is_possible, effect.shift, effect.ratio)
        return conditioned, jnp.where(is_possible, probability, 0.0)

    def _split_and_merge(
        self, joint: Hypotheses, i: int, words: ReceivedWords, some_word_was_used: jax.Array
    ) -> tuple[Hypotheses, jax.Array]:
        """Condition both Gaussians on codeword i in two cases: its leading bits are right, or not; merge four to two.

        The new first Gaussian is that in which all codewords of the message so far were right, the second any other.
        It is about one message alone: its first codeword forgets whether those of the message before were right.

        Args:
            joint: the two Gaussians of (x, y), and their probabilities: the leading bits of all codewords of the
                message so far were right, or not.
            i: component of y.
            words: what was received.
            some_word_was_used: whether another codeword of the same message was used before.

        Returns:
            The hypotheses given codeword i, unchanged if it did not arrive, and the codeword's probability.
        """
        # Four Gaussians [h, a] and their probabilities (2, 2): h = 0 or 1 is the hypothesis so far, and a = 0 if the
        # leading bits of codeword i are right, 1 if not. P[h, a] = P(h) P(codeword i, a | h).
        gaussians, probability = jax.lax.map(lambda x: self._split_by_answer(x, i, words), joint.parts)
        probability = probability * joint.weights[:, None]
        total = jnp.sum(probability)
        # all_right[h, a]: codeword i is right (a = 0), and so are those before it in this message (h = 0). At the first
        # codeword of a message h is about the message before, so that a = 0 alone decides.
        this_is_right = jnp.array([[True, False], [True, False]])
        those_before_are_right = jnp.stack([jnp.asarray(True), ~some_word_was_used])  # by h
        all_right = this_is_right & those_before_are_right[:, None]
        four_gaussians = jax.tree.map(lambda leaf: leaf.reshape(4, *leaf.shape[2:]), gaussians)

        def merge_chosen(chosen: jax.Array) -> tuple[Gaussian, jax.Array]:
            """Merge those of the four Gaussians that are `chosen` (2, 2), and return their probability.

            If it is 0, all four are merged, so that there is some Gaussian.
            """
            chosen_probability = jnp.where(chosen, probability, 0.0).ravel()
            sum_of_chosen = jnp.sum(chosen_probability)
            all_shares = jnp.where(total > 0, probability.ravel() / jnp.where(total > 0, total, 1.0), 0.25)
            chosen_shares = chosen_probability / jnp.where(sum_of_chosen > 0, sum_of_chosen, 1.0)
            shares = jnp.where(sum_of_chosen > 0, chosen_shares, all_shares)
            return merge_mixture(four_gaussians, shares), sum_of_chosen

        # New hypothesis 0 merges the Gaussians in which all are right, new hypothesis 1 the others.
        merged, weights = jax.vmap(merge_chosen)(jnp.stack([all_right, ~all_right]))
        is_used = words.present[i] & (total > 0)
        corrected = Hypotheses(merged, weights / jnp.where(total > 0, total, 1.0))
        return jax.tree.map(lambda new, old: jnp.where(is_used, new, old), corrected, joint), total


def _merge_hypotheses(state: Hypotheses) -> Gaussian:
    """Return one Gaussian with the mean and covariance of the mixture of both hypotheses."""
    return merge_mixture(state.parts, state.weights)


def make_two_hypotheses_filter(base: WordFilter) -> TwoHypothesesFilter:
    """Return the filter that carries two Gaussians, from the one with a single Gaussian, whose updates it uses."""
    return TwoHypothesesFilter(base=base, **make_sizes(base.claim, first(base.plant), base.received))
