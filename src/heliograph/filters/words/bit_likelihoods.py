"""What the received words say of each bit that was sent: likelihoods of a zero and a one, back along the links."""

from collections.abc import Sequence
from itertools import product
from math import prod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.words.word_channel import make_word_link_error
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine, inner_maps, replace_inner_maps
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.modes import ModeOutput, Modes
from heliograph.random_affine.series_and_stack import Series, Stack
from heliograph.random_affine.words.bit_flips import Flips

MOST = 64  # combinations of error rates

Pairs = jax.Array  # (words, bits, 2): likelihoods of a zero and a one


class LinkOfBits(Module):
    """A channel of codewords at one step, as a mixture of channels with known bit error rates.

    Args:
        links: the channel with each combination of error rates.
        weights: probabilities of these in each mode (modes, combinations); one row without modes.
        flag: index of the output that reports the mode with each message; None without modes.
    """

    links: tuple[AbstractRandomAffine, ...]
    weights: Float[np.ndarray, "modes combinations"]
    flag: int | None = eqx.field(static=True)

    def find_probabilities(self, z: jax.Array) -> Float[jax.Array, " combinations"]:
        """Return the probability of each combination of bit error rates, given the mode of the channel.

        The error rates of the channel's links are random: a combination is one possible value of each, and `links` has
        the channel with it. Their probabilities depend on the mode, whose number comes in the output z[flag].

        Args:
            z: what all outputs of the channel delivered at one step. If the mode did not arrive (NaN), all modes count
                as equally likely.
        """
        weights = jnp.asarray(self.weights)  # P(combination | mode), (modes, combinations)
        if self.flag is None:  # no modes: one row
            return weights[0]
        mode = z[self.flag]
        # 1 for the reported mode and 0 for the others.
        mode_probabilities = jnp.where(jnp.isnan(mode), 1 / len(weights), mode == np.arange(len(weights)))
        return mode_probabilities @ weights

    def find_sent_likelihoods(self, received: Pairs) -> list[Pairs]:
        """Return P(received | sent bit is 0) and P(received | it is 1) of each sent bit, by combination of error rates.

        Args:
            received: P(what came | received bit is 0), and is 1, of each received bit (words, bits, 2): 1 and 0 for a
                bit that came as 0, 1 and 1 for one that did not come.

        Returns:
            An array (components of y, bits, 2) for each combination.
        """
        return [infer_sent_bits(link, received) for link in self.links]


def make_link_of_bits(channel: AbstractRandomAffine) -> LinkOfBits:
    """Return a channel of codewords as a mixture of channels with known bit error rates, and their probabilities.

    A codeword is a quantised number sent as bits, each flipped with the bit error rate. A filter of codewords needs the
    probability of the received bits, which is simple if the rates are known. So an error rate of finite support, or a
    choice of one of several links, is replaced by each of its values. If links have modes, the mode must be reported
    with each message, so that its probabilities can be used.

    Raises:
        ValueError: a channel with a delay, modes that are not reported, more than 64 combinations of error rates.
    """
    if channel.past:
        expected = "a link that is not late (linear_filter takes delays)"
        raise fail("channel of a word filter", expected, f"one late by up to {channel.past} steps")
    # A channel without memory: one row of probabilities.
    if not channel.remembers:
        mixture = _list_known_rates(channel)  # pairs (probability, channel with these error rates)
        weights = np.array([[probability for probability, _ in mixture]], dtype=float)
        return LinkOfBits(links=tuple(link for _, link in mixture), weights=weights, flag=None)
    # A channel with modes, whose number is received with the codewords: the channel in each mode.
    link_by_mode = list_links_by_reported_mode(channel)
    if not link_by_mode:
        expected = "one without memory, or with modes of one chain that are told last: hg.model.with_flag(link)"
        raise fail("channel of a word filter", expected, "modes that are not told")
    # Join all channels with known error rates, mode after mode. A mode gives a probability above 0 to its own alone.
    mixture_by_mode = [_list_known_rates(link) for link in link_by_mode]
    links = [link for mixture in mixture_by_mode for _, link in mixture]
    weights = np.zeros((len(link_by_mode), len(links)))
    start = 0
    for mode, mixture in enumerate(mixture_by_mode):
        weights[mode, start : start + len(mixture)] = [probability for probability, _ in mixture]
        start += len(mixture)
    return LinkOfBits(links=tuple(links), weights=weights, flag=channel.outputs - 1)  # the last output is the mode


def list_links_by_reported_mode(channel: AbstractRandomAffine) -> list[AbstractRandomAffine]:
    """Return the channel of codewords in each mode of its chain, without the output that reports the mode.

    A channel may report the mode of its only Markov chain with each message: its last output is then a `ModeOutput`,
    which delivers the mode's number. If that is not so, the list is empty.
    """
    outputs = channel.in_parallel
    mode_outputs = [output for output in outputs if isinstance(output, ModeOutput)]
    chains = {link.memory.identity: link.memory for link in _list_modes(channel)}
    is_only_chain_reported = len(mode_outputs) == 1 and set(chains) == {mode_outputs[0].memory.identity}
    has_other_outputs = len(outputs) > 1
    if not is_only_chain_reported or outputs[-1] is not mode_outputs[0] or not has_other_outputs:
        return []
    modes = next(iter(chains.values())).modes
    return [Stack([_fix_mode(output, mode) for output in outputs[:-1]]) for mode in range(modes)]


def _list_modes(link: AbstractRandomAffine) -> list[Modes]:
    """Return all parts of a link whose law depends on a mode of a Markov chain; the link itself may be one."""
    inside = [mode for inner in inner_maps(link) for mode in _list_modes(inner)]
    return [link, *inside] if isinstance(link, Modes) else inside


def _fix_mode(link: AbstractRandomAffine, mode: int) -> AbstractRandomAffine:
    """Return the link as it is while its Markov chain is in one mode: every part with modes has that mode's law."""
    if isinstance(link, Modes):
        return link.given(mode)
    return replace_inner_maps(link, [_fix_mode(inner, mode) for inner in inner_maps(link)])


def _list_known_rates(link: AbstractRandomAffine) -> list[tuple[float, AbstractRandomAffine]]:
    """Return a link as a mixture of links without random error rates or choices: pairs (probability, link).

    A bit error rate of finite support is replaced by each of its values, and a choice of one of several links by each
    of these. The links inside a link vary independently.
    """
    if isinstance(link, Flips):
        atoms = link.error.list_atoms()
        return [(float(share), Flips(Constant(p), link.dimension, link.per_message)) for share, p in atoms]
    if isinstance(link, Mixture):
        shares = zip(np.asarray(link.choice.probabilities), link.maps, strict=True)
        return [(float(share) * p, fixed) for share, chosen in shares for p, fixed in _list_known_rates(chosen)]
    inner = [_list_known_rates(part) for part in inner_maps(link)]
    if prod(len(fixed) for fixed in inner) > MOST:
        raise fail("channel of a word filter", f"at most {MOST} combinations of error rates", "more")
    combinations = list(product(*inner))
    return [
        (prod(share for share, _ in chosen), replace_inner_maps(link, [fixed for _, fixed in chosen]))
        for chosen in combinations
    ]


def infer_sent_bits(link: AbstractRandomAffine, received: Pairs) -> Pairs:
    """Return the likelihoods of the bits that went into a link, from those of the bits that came out.

    A codeword is a number quantised to bits, and a link may flip, copy or lose its bits. With l'(r) the likelihood of a
    received bit r, the likelihood l(s) of the sent bit s follows by the kind of link. A bit flipped with probability p:
    l(s) = (1 - p) l'(s) + p l'(not s). A bit that was copied: the product over its copies. A bit that nobody received:
    1. Links in series are gone through from the last to the first.

    Args:
        link: a link of bits with known error rates.
        received: likelihoods of 0 and 1 of each bit at its outputs, (words, bits, 2).
    """
    match link:
        case Flips():
            p = jnp.asarray(link.error.moment(1))
            return (1 - p) * received + p * received[..., ::-1]
        case GainAndNoise():  # a selection: each input's copies are the rows that take it
            rows = np.asarray(link.matrix) > 0
            into = [
                _multiply_likelihoods([received[i] for i in np.flatnonzero(column)], received.shape[1:])
                for column in rows.T
            ]
            return jnp.stack(into)
        case Series():
            for part in reversed(link.maps):
                received = infer_sent_bits(part, received)
            return received
        case Stack():  # all parts take the same inputs
            ends = np.cumsum([part.outputs for part in link.maps])[:-1]
            pieces = zip(link.maps, jnp.split(received, ends), strict=True)
            return _multiply_likelihoods([infer_sent_bits(part, piece) for part, piece in pieces], ())
        case Erasure():  # what is lost has likelihoods 1 already
            return infer_sent_bits(link.base, received)
    raise make_word_link_error(type(link).__name__)


def _multiply_likelihoods(factors: Sequence[jax.Array], shape: tuple[int, ...]) -> jax.Array:
    """Return the product of all factors entry by entry; of no factors, as of a bit that nobody received, ones."""
    product = jnp.ones(shape) if not factors else factors[0]
    for factor in factors[1:]:
        product = product * factor
    return product


def is_free_of_flips(link: LinkOfBits) -> bool:
    """Return whether no bit is ever flipped: every error rate inside is 0, in all combinations of error rates."""
    return all(float(flips.error.moment(1)) == 0 for law in link.links for flips in _list_flips(law))


def _list_flips(link: AbstractRandomAffine) -> list[Flips]:
    """Return all parts of a link that flip bits (`Flips`); the link itself may be one."""
    inside = [flips for inner in inner_maps(link) for flips in _list_flips(inner)]
    return [link, *inside] if isinstance(link, Flips) else inside
