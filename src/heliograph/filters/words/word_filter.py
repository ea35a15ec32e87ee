"""Filter behind codewords of finite length, whose bits may flip: exact moments of a Gaussian prior given each word.

A codeword (word, for short) is a number that was rounded to low + i D, i = 0, 1, ..., and is sent as the bits of i. A
dither is a random number that was added before the rounding; both ends know it where it is to be subtracted again.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, join_columns, rounding_of
from heliograph.factors.factored_gaussian import Gaussian, append_rows, impose_moments_of_combination, take_leading
from heliograph.factors.repeated_measurements import triangularise_noise
from heliograph.filters.base import Step, corrects
from heliograph.filters.gaussian.gaussian_prediction import AbstractGaussianStateFilter, second_moments_at_start
from heliograph.filters.gaussian.signal_moments import Signal, find_signal_moments, innovation_covariance
from heliograph.filters.words.bit_likelihoods import LinkOfBits
from heliograph.filters.words.word_moments import WordEffect, find_effect_of_bits, find_effect_of_cell
from heliograph.filters.words.word_sums import SignalPrior, WordGrid
from heliograph.model.estimate import Innovation
from heliograph.model.over_time import OverTime, at
from heliograph.model.sensor import AnySensor
from heliograph.model.words.encoder import Dither
from heliograph.model.words.word_channel import FLAG
from heliograph.numerics.types import Array, ArrayLike
from heliograph.random_affine.moments.second_moments import SecondOrder
from heliograph.random_affine.words.rounding_noise import LARGEST

OFF = 1e-6  # steps by which a received number may miss a word


class WordFilter(AbstractGaussianStateFilter):
    """The Gaussian filter that conditions on the received words themselves.

    Let y ~ N(m, S) be a component of the signal, and M(m) the probability of the received codeword. Given it, y has the
    mean m + S (ln M)' and the variance S + S^2 (ln M)'' (derivatives in m), and x has mean + k (E y - m) and
    P - k k' (S - Var y), k = Cov(x, y) / S. One component follows after another. The variance may grow, if a flipped
    bit leaves y on either of two sides.

    Args:
        sensor: h and the law of v, without rounding.
        links: the laws of the bits, None where no bit flips and the words have no end.
        numbers: second moments of the words as numbers about their centres, for the innovation.
        low: of each component, a word.
        spacing: D of each component.
        centre: of the words of each component.
        indices: component of y of each output of the channel; FLAG for an output that reports the mode.
        bits: of a codeword; 0 for codewords without end.
        dither: of the encoder.
        certain: True if no bit flips.
    """

    sensor: AnySensor
    links: LinkOfBits | OverTime
    numbers: SecondOrder | OverTime
    low: Array
    spacing: Array
    centre: Array
    indices: tuple[int, ...] = eqx.field(static=True)
    bits: int = eqx.field(static=True)
    dither: Dither = eqx.field(static=True)
    certain: bool = eqx.field(static=True)

    @corrects
    def correct(self, state: Gaussian, z: ArrayLike, k: Step = 0) -> tuple[Gaussian, Innovation]:
        """Correct with the codewords that arrived, one component of y after another in the joint Gaussian of (x, y).

        Component y_i gets its exact mean and variance given its codeword; x and the other components follow by their
        regression on y_i.
        """
        z, n = jnp.asarray(z), len(self.states)
        signal = self.predict_signal(state, k)
        noise = triangularise_noise(join_columns(signal.noise, rounding_of(signal.size)))
        joint, log_likelihood = append_rows(state, signal.mean, signal.slopes, noise), jnp.zeros(())
        words = self.identify_received_words(z, at(self.links, k))
        for i in range(len(self.low)):
            row, prior = joint.root[n + i], self.find_signal_prior(joint, i)  # y_i = prior.mean + row xi
            # log P(codeword), and the mean and variance of y_i given it, relative to the prior's deviation and
            # variance.
            effect = self._find_effect_of_word(i, words, prior)
            is_used = words.present[i] & jnp.isfinite(effect.log_mass) & (prior.deviation > 0)
            row = jnp.where(is_used, row, 0.0)
            shift, ratio = jnp.where(is_used, effect.shift, 0.0), jnp.where(is_used, effect.ratio, 1.0)
            # The joint Gaussian in which y_i has these moments, and its slopes on y_i are unchanged.
            joint = impose_moments_of_combination(joint, row, shift * prior.deviation, ratio)
            log_likelihood = log_likelihood + jnp.where(words.present[i], effect.log_mass, 0.0)
        # A received number that is no codeword is impossible.
        log_likelihood = jnp.where(words.are_words, log_likelihood, -jnp.inf)
        return take_leading(joint, n), self.compute_innovation(signal, words, z, at(self.numbers, k), log_likelihood)

    @property
    def of_atoms(self) -> bool:
        """Always True: codewords are finitely many or discrete, so likelihood 0 says that the model excludes z."""
        return True

    def predict_signal(self, state: Gaussian, k: Step) -> Signal:
        """Return the moments of the sensor's signal y = h(x) + v before it is rounded, for the predicted x."""
        plant, sensor = at(self.plant, k), at(self.sensor, k)
        return find_signal_moments(plant, sensor, self.transform, state, second_moments_at_start(self.plant, self))

    def identify_received_words(self, z: jax.Array, link: LinkOfBits) -> "ReceivedWords":
        """Return which codeword of each component was received, and likelihoods of the bits that were sent.

        A sensor sends codewords (values rounded to low + i spacing, i written in bits), of which the link may flip some
        bits. z (one step) has a number for each output of the channel: a received codeword, or the mode of the link, as
        `indices` says. If dither (noise that the sender adds before rounding) is subtracted, that of each codeword
        follows. A component may come several times, as copies over several paths. A codeword is returned as its number
        i. `link`: the channel's mixture of bit error rates at this step.
        """
        outputs = len(self.indices)
        # Rows of z that are words, the component of y of each, and how many steps it lies above the lowest word.
        rows = [i for i, index in enumerate(self.indices) if index != FLAG]
        component = np.array([self.indices[i] for i in rows])
        dither = z[outputs:] if len(z) > outputs else jnp.zeros(len(rows))
        index = (z[np.array(rows)] - jnp.asarray(self.low)[component]) / jnp.asarray(self.spacing)[component]
        arrived = ~jnp.isnan(index) & ~jnp.isnan(dither)
        number = jnp.round(jnp.where(arrived, index, 0.0))
        # What arrives must be a word, up to the rounding of low and of low + i D, both in units of D.
        size = jnp.abs(number) + jnp.abs(jnp.asarray(self.low) / jnp.asarray(self.spacing))[component]
        tolerance = OFF + 8 * np.finfo(index.dtype).eps * size
        no_word = jnp.abs(jnp.where(arrived, index, 0.0) - number) > tolerance
        if self.bits:
            no_word = no_word | (number < 0) | (number > 2.0**self.bits - 1)
        # The first copy of each component that arrived, and its dither, which all copies share.
        first_copies = []
        for i in range(len(self.low)):
            copies = np.flatnonzero(component == i)
            first_copies.append(_pick_first_copy([WordCopy(arrived[j], number[j], dither[j]) for j in copies]))
        present, numbers, dithers = (jnp.stack(values) for values in zip(*first_copies, strict=True))
        # P(received | sent 0) and P(received | sent 1) of each bit, under each possible set of error rates of the link,
        # and the probabilities of these sets.
        pairs, weights = list[jax.Array](), jnp.ones(1)
        if not self.certain:  # bits may flip
            bit = jnp.mod(jnp.floor(number[:, None] / 2.0 ** np.arange(self.bits)), 2.0)
            received_bits = jnp.stack([1 - bit, bit], axis=-1)
            pairs = link.find_sent_likelihoods(jnp.where(arrived[:, None, None], received_bits, 1.0))
            weights = link.find_probabilities(z[:outputs])
        return ReceivedWords(
            numbers=numbers,
            dithers=dithers,
            present=present,
            pairs=pairs,
            weights=weights,
            are_words=~jnp.any(no_word & arrived),
        )

    def find_signal_prior(self, joint: Gaussian, i: int) -> SignalPrior:
        """Return mean and standard deviation of y_i, from the joint Gaussian of (x, y), mean + L xi.

        Its row behind the n states of x is that of y_i, so that Var y_i is the sum of (row_j)^2 Var xi_j.
        """
        index = len(self.states) + i
        return SignalPrior(joint.mean[index], jnp.sqrt(joint.root[index] ** 2 @ joint.variances))

    def condition_by_leading_bits(self, i: int, words: "ReceivedWords", prior: SignalPrior, leading: int) -> WordEffect:
        """Return the effect of the received codeword on y_i in two cases: its leading bits arrived as sent, or not.

        A codeword holds the quantised y_i in `self.bits` bits, and bits may flip on the way. The filter treats the two
        cases apart, since a flip of a high bit moves the value far.

        Args:
            i: component of y.
            words: what was received; `words.pairs` has for each combination of error rates the likelihoods of a sent 0
                and of a sent 1, (components, bits, 2), and `words.weights` the combinations' probabilities.
            prior: mean and deviation of y_i.
            leading: how many of the highest bits must all be right in the first case.

        Returns:
            log P(codeword, case), shift of the mean in deviations, and ratio of variances, (2,) each: right, not right.
        """
        pairs, bits = [pair[i] for pair in words.pairs], np.arange(self.bits)
        # P(received, all leading bits right | word sent): a leading bit other than the received one has likelihood 0.
        received_bit = jnp.mod(jnp.floor(words.numbers[i] / 2.0**bits), 2.0)
        equals_received = jnp.stack([1 - received_bit, received_bit], axis=-1)
        leading_is_right = jnp.where((bits >= self.bits - leading)[:, None], equals_received, 1.0)
        right_pairs = [pair * leading_is_right for pair in pairs]
        # P(received, not right) = P(received) - P(received, right): weights 1 and -1 of the same sums over `pairs` and
        # then `right_pairs`; P(received, right) has the weights 0 and 1.
        if_right = jnp.append(0 * words.weights, words.weights)
        if_wrong = jnp.append(words.weights, -words.weights)
        return find_effect_of_bits(
            pairs=[*pairs, *right_pairs],
            weights=jnp.stack([if_right, if_wrong]),
            received=words.numbers[i],
            grid=self._word_grid(i, words),
            prior=prior,
            dither=self.dither,
        )

    def _find_effect_of_word(self, i: int, words: "ReceivedWords", prior: SignalPrior) -> WordEffect:
        """Return log P(codeword of y_i), the shift of the mean of y_i in deviations, and the ratio of its variances.

        If no bit can flip (`self.certain`), y_i lies in the cell of numbers that are rounded to the codeword; a dither
        makes the cell's edges smooth. Else the law of y_i is a sum over all codewords that may have been sent, each
        with the likelihood of its bits, a product over `words.pairs`.
        """
        grid = self._word_grid(i, words)
        if self.certain:
            return find_effect_of_cell(words.numbers[i], grid, prior, self.dither)
        pairs = [pair[i] for pair in words.pairs]
        return find_effect_of_bits(pairs, words.weights, words.numbers[i], grid, prior, self.dither)

    def _word_grid(self, i: int, words: "ReceivedWords") -> WordGrid:
        """Return the values that the codewords of y_i stand for: the lowest, the step between them, and their bits.

        A dither that is known was added before rounding, so it is subtracted from them.
        """
        return WordGrid(jnp.asarray(self.low)[i] - words.dithers[i], jnp.asarray(self.spacing)[i], self.bits)

    def compute_innovation(
        self, signal: Signal, words: "ReceivedWords", z: jax.Array, numbers: SecondOrder, log_likelihood: jax.Array
    ) -> Innovation:
        """Return the innovation of the received codewords, taken as numbers: q - c less what was expected of it.

        A codeword q stands for the signal y rounded to steps D, in a range about the centre c. As a number it is q - c
        = g (y - c + d + r) + n with the error r of rounding, the sender's dither d, and a random gain g and noise n by
        which flipped bits change numbers (all as vectors). So its innovation is q - c - E[g] d - E[g] E(y - c) - E n.

        Args:
            signal: mean, covariance and noise of y before it is rounded.
            words: what was received.
            z: for each output of the channel a codeword q, or the number of the reported mode; then the dithers d of
                the codewords, if they are subtracted.
            numbers: moments of the gain G and noise n of all codewords as numbers, (words, components of y).
            log_likelihood: of the codewords.

        Returns:
            Value and covariance with an entry for each number in z: NaN for modes and dithers, which are given.
        """
        about_centre = self._add_rounding_as_noise(signal)
        # Rows of z that are codewords (not the reported mode, FLAG), and the component of y in each.
        rows = np.array([i for i, index in enumerate(self.indices) if index != FLAG])
        component = np.array(self.indices)[rows]
        gain = jnp.asarray(numbers.mean_gain)
        values = z[rows] - jnp.asarray(self.centre)[component]
        # E[g] d. A codeword carries one component of y, so that its row of E[G] sums to its E[g].
        has_dithers = len(z) > len(self.indices)
        dithers = jnp.sum(gain, axis=1) * z[len(self.indices) :] if has_dithers else 0.0
        value = values - dithers - (gain @ about_centre.mean + jnp.asarray(numbers.offset))
        covariance = innovation_covariance(about_centre, numbers)
        present = ~jnp.isnan(value)
        covariance = jnp.where(present[:, None] & present, covariance, jnp.nan)
        # In the rows of words; NaN in those of flags and dithers, of which nothing is expected.
        return Innovation(
            value=jnp.full(len(z), jnp.nan).at[rows].set(value),
            covariance=jnp.full((len(z), len(z)), jnp.nan).at[rows[:, None], rows].set(covariance),
            log_likelihood=log_likelihood,
        )

    def _add_rounding_as_noise(self, signal: Signal) -> Signal:
        """Return the moments of y - c, c the centre of the codewords, with the error of rounding y as one more noise.

        For steps D its variance is a number of the dither's kind times D^2, the largest that it may have.
        """
        rounding_variance = LARGEST[self.dither].error * jnp.asarray(self.spacing) ** 2
        mean = signal.mean - jnp.asarray(self.centre)
        noise = join_columns(signal.noise, WeightedColumns(np.eye(len(self.low)), rounding_variance))
        second = signal.covariance + jnp.diag(rounding_variance) + jnp.outer(mean, mean)
        return signal._replace(mean=mean, noise=noise, second=second)


class ReceivedWords(NamedTuple):
    """What was received: number of the word, dither and presence of each component, and what the bits say.

    Shapes: numbers, dithers, present (components,), pairs (components, bits, 2) of each combination of error rates,
    weights of these; are_words () says whether all that came are words.
    """

    numbers: jax.Array
    dithers: jax.Array
    present: jax.Array
    pairs: list[jax.Array]
    weights: jax.Array
    are_words: jax.Array


class WordCopy(NamedTuple):
    """One copy of a codeword, as it came over one path: whether it arrived, its number and its dither, all ()."""

    arrived: jax.Array
    number: jax.Array
    dither: jax.Array


def _pick_first_copy(copies: list[WordCopy]) -> WordCopy:
    """Return the first copy of a codeword that arrived; one that did not, with zeros, if none did.

    The loop goes from the last copy to the first, so that the first one that arrived overwrites all others.
    """
    arrived, number, dither = jnp.asarray(False), jnp.zeros(()), jnp.zeros(())
    for copy in reversed(copies):
        arrived = copy.arrived | arrived
        number = jnp.where(copy.arrived, copy.number, number)
        dither = jnp.where(copy.arrived, copy.dither, dither)
    return WordCopy(arrived, number, dither)
