"""Sentences on what a recording contradicts: sizes and memory of innovations, constant errors, and what to do."""

from collections.abc import Sequence

from heliograph.report.diagnosis.constant_sensor_error import ConstantError
from heliograph.report.diagnosis.innovation_tests import ImpossibleInnovation
from heliograph.report.diagnosis.stuck_sensors import StuckValue
from heliograph.simulation.declared_noise.judgement import DeclaredJudgement
from heliograph.simulation.results.whiteness import MemoryTest


def _format_outputs_and_sizes(outputs: Sequence[str], sizes: Sequence[float]) -> tuple[str, str]:
    """Return " of y, z" ("" if `outputs` is [""], which means all), and the sizes as text."""
    return f" of {', '.join(outputs)}" if outputs != [""] else "", ", ".join(f"{size:.2f}" for size in sizes)


def say_overconfident(name: str, outputs: Sequence[str], sizes: Sequence[float]) -> str:
    """Return the sentence on a filter whose NIS (squared innovations over their variance) is above its interval.

    `sizes` says for each of `outputs` how many times larger the squares are than claimed. `name`: of the filter.
    """
    of, times = _format_outputs_and_sizes(outputs, sizes)
    return (
        f"{name} is too sure{of}: the mean square of its innovations is {times} times what it claims; the model leaves "
        "something out"
    )


def say_innovation_is_impossible(name: str, found: ImpossibleInnovation, probability: float) -> str:
    """Return the sentence on one innovation that is larger than any law with the claimed variance makes plausible.

    If the claim holds, any of the innovations is as large with at most this `probability`. `name`: of the filter.
    `found`: its row and its size in claimed deviations.
    """
    return (
        f"{name} is too sure, or the measurement is wrong: its innovation in row {found.row} is {found.deviations:.3g} "
        f"claimed deviations, which less than {probability:.1%} of such recordings have, whatever the law of noise"
    )


def say_innovations_are_correlated(name: str, test: MemoryTest) -> str:
    """Return the sentence on innovations that are correlated in time; `test` has their correlation at each lag.

    `test.predictable` is the share of their variance that earlier innovations predict. `name`: of the filter.
    """
    return (
        f"{name} could know more: its innovations are correlated with those before ({test.correlation[0]:.2f} with the "
        f"last, {test.predictable:.0%} of their variance follows from {len(test.correlation)}); "
        "links, sensors or the plant remember what the model forgets. Until that is a state of the model "
        "(hg.model.with_bias, hg.model.with_past, a link with memory), the size of innovations cannot tell how "
        "large the errors are"
    )


def say_constant_error(name: str, error: ConstantError) -> str:
    """Return the sentence on an output's constant error, which explains all doubts of a filter or most of them.

    If it does not explain all (`nothing_else`), `error.explained` is the share of the excess of the filter's squared
    innovations that it explains. `name`: of the filter. `error` as a text has the output, the error and its interval.
    """
    if not error.nothing_else:
        share = f"{min(error.explained, 0.99):.0%} of what its squared innovations are too large by"
        return f"{name}: a constant error of {error}, would explain {share}, not all"
    return (
        f"{name} is off by a constant error of {error}: it pulls the estimates, and makes innovations of the others "
        "larger too. hg.model.with_bias makes it a state, which the filter then estimates"
    )


def say_node_differs(error: ConstantError) -> str:
    """Return the sentence on the output that differs from what the other nodes say by a constant.

    `error` as a text has the output, the error and its interval.
    """
    return (
        f"nodes disagree: a constant error of {error}, explains it. By itself a node takes it for the state; "
        "hg.model.with_bias makes it a state of its own"
    )


def say_underconfident(name: str, outputs: Sequence[str], sizes: Sequence[float]) -> str:
    """Return the sentence on a NIS below its interval, as it is also if a filter follows its sensor's slow error.

    `name`: of the filter. `sizes`: for each of `outputs` the mean square of its innovations over what is claimed.
    """
    of, times = _format_outputs_and_sizes(outputs, sizes)
    return (
        f"{name} expects more{of} than comes: the mean square of its innovations is {times} times what it claims. "
        "Either noises are stated too large, or the sensor's error changes slowly and the filter follows it: then its "
        "claim is too small. Innovations cannot tell the two apart, a reference can"
    )


def say_how_to_refuse_repeats(held: StuckValue, refused: bool) -> str:
    """Return words on an output that repeats a value: that it was refused, or how to have it refused.

    `held.stuck` is how often a value may repeat before the option `stuck` of a node refuses it. `refused`: whether the
    node has this option already.
    """
    if refused:
        return "what repeated for longer was refused"
    return (
        "what else is said of filters that use it may be due to that. "
        f"stuck={held.stuck} of its node refuses what repeats for longer"
    )


def say_declared_variances_are_off(judgements: Sequence[DeclaredJudgement], unit: str) -> list[str]:
    """Return the sentences on noise variances that messages report; with several links, their outputs are named.

    A link may report the variance of its noise with each message. `judgements`: for each such link, the comparison of
    these variances with the innovations; its `sentences` say what is wrong with them, none where nothing is, and
    `outputs` has the names of what the link carries. `unit`: of the plant's time, for the memory of a bias.
    """
    several = len(judgements) > 1
    return [
        f"{', '.join(judgement.outputs)}: {sentence}" if several else sentence
        for judgement in judgements
        for sentence in judgement.sentences(unit)
    ]
