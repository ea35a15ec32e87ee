"""Misprints, each taken as a statement: what the printed formula does."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

import heliograph as hg
from heliograph_studies.statement import Evidence, Statement, Verdict, holds
from heliograph_studies.successive_relays.compute import Misprinted, Outcome
from heliograph_studies.successive_relays.setting import TRANSITION, shadowing
from heliograph_studies.successive_relays.setting import circuit as matrix_of

ROUNDING = 1e-9  # relative, of traces followed over many steps
DIGITS = 6e-5  # of the printed matrix, which has four decimals
MISREAD = ("(2)", "(15)", "(17)", "(20)", "(22)", "(23)", "(25)", "(27)", "(62)", "(65)")  # indices and transposes
# what each step of Algorithm 1 gives, and what it needs
ORDER = (("covariances at k", ("covariances at k - 1", "gains at k")), ("gains at k", ("covariances at k - 1",)))


def proofs() -> list[Statement]:
    """What the proofs of the bounds rest on, the algorithm, and notation."""
    noise, least, order, bound = _largest_noise(), *_noise_squared()
    largest = 0.1 / 0.5**2  # phi / mu^2 of that law: s is below it
    return [
        Statement("o I ≤ O O′", "Assumption 1", f"p_{order} = {bound[0]:.4g} with o = O² on a scalar system",
            f"P_{order} = {least:.4g} there; with o = O, which the proofs use, p_{order} = {bound[1]:.4g}",
            {"bound": bound[0], "error": least}, lambda bound, error: holds(bound <= error)),
        Statement("w̃ = ρ w̄, any ρ below 1, in the lower bound", "(34)",
            "m ≥ 0.5 with W = diag(0.01, 1), ρ = 0.5",
            f"smallest eigenvalue of Ξ₁ is {noise:.4g}; the lower w is meant, with ρ ≤ (φ - s μ²) / "
            "(φ + μ²)", {"bound": 0.5, "error": noise}, lambda bound, error: holds(bound <= error)),
        Statement("the factor μ²/φ in (34) and (46), −Γ Ξ Γ′ in (38)", "(34), (38), (46)", "μ²/φ",
            "1 / s with s < φ/μ², so 1 / s > μ²/φ: (46) and ρₖ do not follow from (38)",
            {"printed": 1 / largest, "needed": 1 / (0.99 * largest)},
            lambda printed, needed: holds(printed >= needed)),
        Statement("the algorithm can be run as ordered", "Algorithm 1",
            "covariances at k before gains at k; Π from (1)",
            "gains at k use covariances at k - 1 and come first; Π from (13)",
            {"used_before_known": used_before_known(ORDER)},
            lambda used_before_known: holds(used_before_known == 0)),
        Statement("notation", ", ".join(MISREAD),
            "[w v]; wₖ for wₖ₋₁; lost transposes and terms; x(t) for its derivative",
            "read as meant; the results stated after them are right", {"formulas_not_as_meant": len(MISREAD)},
            lambda formulas_not_as_meant: holds(formulas_not_as_meant == 0)),
    ]  # fmt: skip


def used_before_known(order: Sequence[tuple[str, Sequence[str]]]) -> int:
    """How many quantities an algorithm's steps (what each gives, what it needs) use before they are given."""
    known, early = {"covariances at k - 1"}, 0
    for gives, needs in order:
        early += len(set(needs) - known)
        known.add(gives)
    return early


def _alternating(
    plant: hg.LinearPlant, sensor: hg.LinearSensor, law: hg.random_affine.LogNormal, relay: float, remote: float
) -> hg.model.RelayNetwork:
    """Two relays in turn over one law of gains, with these noises at relay and remote filter."""
    slots = [
        {item: {"sensor": hg.hop(law, relay), other: hg.hop(law, 0.0)}, "receiver": {other: hg.hop(law, remote)}}
        for item, other in (("relay_2", "relay_1"), ("relay_1", "relay_2"))
    ]
    return hg.model.RelayNetwork(plant, sensor, ("relay_1", "relay_2"), slots)


def _largest_noise() -> float:
    """Smallest eigenvalue of Xi_1 at k = 40 where relays receive next to nothing and noise is unequal."""
    plant = hg.LinearPlant(0.1 * np.eye(2), np.diag([0.01, 1.0]), np.zeros(2), 0.01 * np.eye(2))
    sensor = hg.LinearSensor([[1.0, 1.0]], [[1.0]])
    network = _alternating(plant, sensor, shadowing(0.5, 0.1), 1e6, 1e6)
    return float(np.linalg.eigvalsh(hg.relays.local_error_design(network, 40).covariance["relay_1"][-1])[0])


def _noise_squared() -> tuple[float, int, tuple[float, float]]:
    """P_4 of a scalar system with O = 100, and (52) with o = O^2 and with o = O."""
    tau, w, noise, order = 0.81, 1e-6, 100.0, 4
    plant, sensor = hg.LinearPlant([[0.9]], [[w]], [0.0], [[10.0]]), hg.LinearSensor([[1.0]], [[1e-6]])
    network = _alternating(plant, sensor, shadowing(1.0, 1e-6), 1e-6, noise)
    bounds, upper = [10.0, 10.0], 10.0
    for _ in range(order):
        factors = [o / (o + 4 * upper) for o in (noise**2, noise)]
        bounds = [tau * factor * bound + w for factor, bound in zip(factors, bounds, strict=True)]
        upper = tau * upper + w
    return float(hg.relays.local_error_design(network, order).trace("receiver")[-1]), order, (bounds[0], bounds[1])


def misprints(outcome: Outcome) -> list[Statement]:
    """In the recursion."""
    wrong = outcome.misprints
    more, less = wrong["lemma_1_process"], wrong["lemma_1_sensor_noise"]
    gain, seventh = wrong["theorem_1"], wrong["lemma_7"]
    return [
        Statement("Πₖ from Σ V Σ′", "(13), Lemma 1", "V",
            f"W: nothing on the example, where V = W; with W = 4 V {_effect(more, -1)}; with V = 4 W "
            f"{_effect(less, -1)}", *_judged(more)),
        Statement("Ξᵢ in the term with γ₃ of the gain", "(30), proof of Theorem 1; perhaps the scan", "Ξᵢ",
            f"Ξᵢⱼ, as in (29); with Ξᵢ: tr P {_percent(gain.true[10])} at k = 10, {_percent(gain.true[100])} at 100, "
            f"{_percent(gain.true[-1])} steady; tr Ξ₂ {_percent(gain.relay_2[3])} at k = 3",
            *_judged(gain)),
        Statement("variance squared before Pᵢ + Pᵢ′", "Lemma 7, (58), (39); perhaps the scan", "variance squared",
            f"mean squared, as (28); as printed at k = 10: {_effect(seventh, 10)}; steady: {_effect(seventh, -1)}",
            *_judged(seventh)),
        Statement("first bracket of (24) with δᵢ + δⱼ", "(24); perhaps the scan", "δ",
            f"δ̄; as printed, steady: {_effect(wrong['lemma_6_sign'], -1)}",
            *_judged(wrong["lemma_6_sign"])),
        Statement("last term of (24) with Ξᵢ′", "(24); perhaps the scan", "Ξᵢ′",
            f"Ξᵢⱼ′; as printed, steady: {_effect(wrong['lemma_6_last'], -1)}",
            *_judged(wrong["lemma_6_last"])),
    ]  # fmt: skip


def _judged(misprinted: Misprinted) -> tuple[Evidence, Callable[..., Verdict]]:
    """Steady trace claimed and true trace, relative to the right recursion: 1 if the misprint does nothing."""
    return (
        {"claimed": float(misprinted.claimed[-1]), "true": float(misprinted.true[-1])},
        lambda claimed, true: holds(max(abs(claimed - 1), abs(true - 1)) <= ROUNDING),
    )


def _effect(misprinted: Misprinted, k: int) -> str:
    return f"claimed tr P is {misprinted.claimed[k]:.2f} of the truth, and the truth {_percent(misprinted.true[k])}"


def _percent(ratio: float) -> str:
    return f"{100 * (ratio - 1):+.1f} %"


def circuit(outcome: Outcome) -> list[Statement]:
    """In the example."""
    gap = {h: float(np.max(np.abs(matrix_of(h) - TRANSITION))) for h in (0.5, 5.0)}
    printed = replace(outcome.setting, transition=matrix_of(0.5)).network()
    other = hg.relays.local_error_design(printed, 10).trace("receiver")[10]
    plus = matrix_of(5.0, second_sign=1.0)
    radius, wrong = float(np.max(np.abs(np.linalg.eigvals(plus)))), float(np.max(np.abs(plus - TRANSITION)))
    remote = float(outcome.trace["remote"][10])
    return [
        Statement("L = 0.5 H gives the printed Γ", "Section IV", "0.5 H",
            f"largest difference {gap[0.5]:.3f}; 5 H gives it to {gap[5.0]:.1g} (four printed decimals). With 0.5 H tr "
            f"P₁₀ is {other:.3g}, not {remote:.3g}",
            {"largest_difference": gap[0.5]}, lambda largest_difference: holds(largest_difference <= DIGITS)),
        Statement("second capacitor's equation with + i_L", "Section IV", "+ i_L",
            f"the matrix A has - i_L; with + the plant has spectral radius {radius:.3f}",
            {"largest_difference": wrong}, lambda largest_difference: holds(largest_difference <= DIGITS)),
    ]  # fmt: skip
