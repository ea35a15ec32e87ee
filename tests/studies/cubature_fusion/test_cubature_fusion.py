"""The reproduction of cubature fusion: its constants, its one-step numbers, a small run, and what it writes.

All filters of both scenarios take minutes to compile, so the files are checked with made-up statistics of the same
shape, and the numbers with a run of a few filters.
"""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph_studies import cubature_fusion
from heliograph_studies.cubature_fusion import compute, one_step, statements
from heliograph_studies.cubature_fusion.compute import MixedCross, variants
from heliograph_studies.cubature_fusion.setting import (
    NODES,
    PRINTED,
    STATES,
    STRONG,
    channel,
    cubature,
    filters,
    plant,
    sensor,
)  # fmt: skip
from heliograph_studies.statement import Sampled
from tests import machine
from tests.oracles import cubature_fusion as oracle
from tests.oracles import relayed_machine
from tests.studies.verdicts import both, check_verdicts

pytestmark = pytest.mark.slow

FILTERS = {"open_loop", "mean_gain", "extended_polytope", "cubature_printed", "cubature_tight", "cubature_polytope",
           "cubature_zero_mean"}  # fmt: skip
BOUNDED = FILTERS - {"open_loop", "mean_gain"}
FUSED = {"ci_optimal", "ci_equal", "central"}
NUMBERS = {"rmse", "rmse_se", "mean_trace", "worst_direction"}


@pytest.mark.parametrize(("ours", "theirs"), [(PRINTED, relayed_machine.PRINTED), (STRONG, relayed_machine.STRONG)])
def test_constants_are_those_of_the_oracle(ours, theirs):
    x, eye = np.random.default_rng(0).normal(size=5), np.eye(5)
    with jax.enable_x64(True):
        np.testing.assert_allclose(plant(ours).transition(x, ()), relayed_machine.f(x, theirs), rtol=1e-13)  # rounding
    np.testing.assert_array_equal([sensor(ours, i).matrix for i in range(4)], theirs["C"])
    np.testing.assert_array_equal(ours.guesses, theirs["xhat0"])
    np.testing.assert_array_equal(plant(ours).noise.covariance, theirs["R"])
    np.testing.assert_array_equal(ours.initial_variance * eye, theirs["P0"])
    np.testing.assert_array_equal(ours.claimed_initial_variance * eye, theirs["Xi0"])
    assert (ours.horizon, ours.beta) == (theirs["T"], theirs["beta"])
    for mine, reference in zip(channel(ours).maps, machine.channel(theirs).maps, strict=True):
        np.testing.assert_array_equal(mine.matrix, reference.matrix)
        np.testing.assert_array_equal(mine.noise.covariance, reference.noise.covariance)
        for part in ("values", "probabilities", "radius"):
            np.testing.assert_array_equal(getattr(mine.law, part), getattr(reference.law, part))


@pytest.mark.parametrize(("s", "theirs"), [(PRINTED, relayed_machine.PRINTED), (STRONG, relayed_machine.STRONG)])
@pytest.mark.parametrize(("sign", "terms"), [(1, oracle.printed_terms), (-1, oracle.tight_terms)])
def test_terms_of_the_bounds_are_those_of_the_oracle(s, theirs, sign, terms):
    ours, reference = one_step.box_terms(one_step.channel_of(s), sign), terms(theirs)
    outcome = ours.mu, ours.V + ours.d**2, ours.d, ours.X2
    np.testing.assert_allclose(outcome, [reference.mu, reference.V, reference.d, reference.X2], rtol=1e-13)  # rounding


def test_the_minus_alone_is_no_bound_and_the_positive_part_repairs_it():
    law = hg.Discrete([0.0, 1.0], [1.0, 0.0], 0.9)
    possible = hg.Discrete([0.0, 1.0], [0.5, 0.5])
    variance = possible.moment(2) - possible.moment(1) ** 2
    assert one_step.variance_bound(law, 0) < variance <= one_step.variance_bound(law, -1)


def test_theorem_1_survives_enumeration():
    for sign in (1, -1):
        violations, margin = one_step.enumerate_theorem_1(100, 0, sign)
        assert violations == 0 and margin > 0


@pytest.mark.parametrize(("term", "share"), [("V", 0.5), ("d", 0.0)])
def test_the_enumeration_finds_a_term_that_is_too_small(monkeypatch, term, share):
    honest = one_step.box_terms

    def smaller(ch, sign):
        terms = honest(ch, sign)
        return terms._replace(**{term: share * getattr(terms, term)})

    monkeypatch.setattr(one_step, "box_terms", smaller)
    assert one_step.enumerate_theorem_1(100, 0, -1)[0] > 0


def test_the_cubature_prediction_misses_the_bilinear_terms():
    gap = (
        one_step.predicted(PRINTED, hg.filters.Cubature())[1]
        - one_step.predicted(PRINTED, hg.filters.PolynomialMoments(2))[1]
    )
    assert np.linalg.eigvalsh(gap)[0] == pytest.approx(-((0.1 * 1.25) ** 2), rel=1e-10)  # -(h Xi)^2, by hand


def test_through_a_perfect_channel_the_printed_bound_is_off():
    for s in (PRINTED, STRONG):
        assert one_step.perfect_channel_excess(s) > 1.0  # more than twice the Kalman filter's trace


def test_mixed_points_do_no_harm_where_propagation_moves_nothing():
    still = hg.Plant(lambda x, u: jnp.asarray(x), np.zeros((5, 5)), np.zeros(5), np.eye(5))
    base = hg.cubature_filter(
        still, sensor(STRONG, 0), channel(STRONG), hg.filters.Polytope(hg.filters.Scalars(*STRONG.beta))
    )
    z = np.array([0.3, -0.2])
    mixed = MixedCross(base)
    (state, _), (expected, _) = mixed.step(mixed.init(), z), base.step(base.init(), z)
    estimate = mixed.estimate(state)
    np.testing.assert_allclose(estimate.mean, expected.mean, atol=1e-13)
    np.testing.assert_allclose(estimate.covariance, expected.covariance, atol=1e-13)


def test_a_small_run_agrees_with_another_implementation():
    nodes = {
        name: hg.Node(sensor(STRONG, i), channel(STRONG), {
            "mean_gain": filters(STRONG, i)["mean_gain"],
            "polytope": cubature(STRONG, i, hg.filters.Polytope(hg.filters.Scalars(*STRONG.beta))),
        }) for i, name in enumerate(NODES)
    }  # fmt: skip
    statistics = hg.monte_carlo(hg.Network(plant(STRONG), nodes), STRONG.horizon, 128, 0, hg.Statistics())
    for name, expected in (("mean_gain", 0.1963), ("polytope", 0.0789)):  # of an independent implementation
        rmse, error = hg.simulation.pool([statistics[node][name] for node in NODES]).rmse()
        assert abs(rmse - expected) < 4 * error, (name, rmse, error)


def made_up(s, names, fused, steps, runs=64):
    """An outcome of the right shape: errors of every filter from its own claim, with made-up claims."""
    rng, batches = np.random.default_rng(1), 50

    def statistics():
        bound = rng.uniform(0.5, 1.0) * np.eye(5) * np.linspace(1.0, 0.2, steps)[:, None, None]
        errors = rng.normal(size=(runs, steps, 5)) * np.sqrt(np.diagonal(bound, axis1=1, axis2=2))
        outer = np.einsum("rti,rtj->rtij", errors, errors)
        deal = (np.arange(runs)[:, None] % batches == np.arange(batches)).astype(float)
        half = np.triu_indices(5)
        sums = np.einsum("rb,rtij->btij", deal, outer)[..., half[0], half[1]]
        claimed = np.tile(bound[:, half[0], half[1]], (batches, 1, 1))
        return hg.simulation.ErrorStatistics(deal.sum(0), sums, claimed, np.zeros((batches, steps)), "nominal")

    def estimate():
        return hg.model.Estimate(rng.normal(size=(1, steps, 5)), np.tile(np.eye(5), (1, steps, 1, 1)), "nominal")

    by_node = {node: {name: statistics() for name in names} for node in NODES}
    shown = {node: {"cubature_printed_fixed": estimate()} for node in NODES} | {"fused": {"ci_printed": estimate()}}
    record = hg.Record(np.arange(1.0, steps + 1), STATES, rng.normal(size=(1, steps, 5)), {}, shown)
    return compute.Runs(s, by_node | {"fused": {name: statistics() for name in fused}}, record)


@pytest.fixture(scope="module")
def result():
    names = [*filters(PRINTED, 0), *variants(PRINTED, 0)]
    fused = list(compute.network(PRINTED).fused)
    early = made_up(STRONG, ["cubature_zero_mean"], list(compute.zero_mean_fusion(STRONG)), 3)
    chosen = cubature_fusion.Setting(runs=64)
    return compute.outcome(chosen, made_up(PRINTED, names, fused, 40), made_up(STRONG, names, fused, 100), early)


def test_every_promised_number_is_in_the_summary(result, tmp_path, fits):
    replace(cubature_fusion.publication, compute=lambda *_: result).run(cubature_fusion.Setting(runs=64), tmp_path)
    folder = tmp_path / "cubature-fusion"
    summary = json.loads((folder / "summary.json").read_text())
    for name in ("printed", "strong"):
        scenario = summary["scenarios"][name]
        assert FILTERS | {f"{n}_fixed" for n in BOUNDED} <= set(scenario["filters"])
        assert set(scenario["fused"]) >= FUSED
        for numbers in [*scenario["filters"].values(), *scenario["fused"].values()]:
            assert set(numbers) == NUMBERS
            assert set(numbers["worst_direction"]) == {"ratio", "standard_error", "z", "step", "node"}
    for claim in summary["claims"]:
        assert set(claim) == {"claim", "source", "paper", "ours", "verdict", "evidence"} and claim["ours"]
        assert claim["verdict"] in {"holds", "holds_vacuously", "does_not_apply", "fails"}
    assert len({claim["claim"] for claim in summary["claims"]}) == len(summary["claims"])
    for number in range(1, 13):
        assert len(list(folder.glob(f"fig{number:02d}_*.png"))) == 1
    assert "<svg" not in (folder / "report.html").read_text().lower().replace("data:image/svg", "")
    assert not [p for p in tmp_path.iterdir() if p != folder]
    fits(folder / "report.html")


def test_the_record_is_labelled_and_agrees_with_the_statistics(result, tmp_path):
    xarray = pytest.importorskip("xarray")
    compute.write_record(result, tmp_path)
    with xarray.open_dataset(tmp_path / "record.nc", engine="h5netcdf") as record:
        assert record.rmse.dims == ("scenario", "filter", "node", "time")
        item = record.sel(scenario="printed", filter="cubature_tight", node="3")
        expected = result.printed.statistics["3"]["cubature_tight"]
        np.testing.assert_array_equal(item.rmse.values[:40], expected.rmse_over_time())
        assert np.all(np.isnan(item.rmse.values[40:]))
        np.testing.assert_array_equal(
            record.fused_claimed_trace.sel(scenario="strong", fused="ci_equal").values,
            np.trace(result.strong.statistics["fused"]["ci_equal"].claimed(), axis1=-2, axis2=-1),
        )


def all_statements(result):
    return [statement for part in statements(result).values() for statement in part]


def test_claims_follow_the_numbers(result):
    by_text = {c.text: c.verdict for c in all_statements(result)}
    text = "The polytope bound is one"
    assert by_text[text] == "holds"  # made up from their own claims
    polytope = {node: by_name | {"cubature_polytope": overstated(by_name["cubature_polytope"])}
                for node, by_name in result.strong.statistics.items() if node != "fused"}  # fmt: skip
    strong = replace(result.strong, statistics=result.strong.statistics | polytope)
    assert {c.text: c.verdict for c in all_statements(replace(result, strong=strong))}[text] == "fails"


BOUND = both("actual_over_claimed", Sampled(1.02, 0.01), Sampled(1.05, 0.01))
BELOW = both("local", Sampled(0.0, 0.1), Sampled(9.0, 0.1))
VERDICTS = [
    ("(10) is an upper bound", both("violations", 0, 1)),
    ("The filter's Ξ", {"holds": {"printed": Sampled(0.9, 0.1), "strong": Sampled(1.2, 0.1)},
                        "fails": {"printed": Sampled(0.9, 0.1), "strong": Sampled(1.4, 0.1)}}),
    ("(29) minimises", both("relative_gradient", 1e-13, 1e-3)),
    ("Ξ stays below", {"holds": {"factor": 0.99}, "does_not_apply": {"factor": 1.01}}),
    ("The scheme reliably", {
        "holds": {"fused": Sampled(1, 0), "without_measurements": Sampled(2, 0), "state": 3.0},
        "holds_vacuously": {"fused": Sampled(1, 0), "without_measurements": Sampled(1, 0), "state": 3.0},
        "fails": {"fused": Sampled(4, 0), "without_measurements": Sampled(5, 0), "state": 3.0}}),
    ("The fused trace", both("least_gain_percent", 0.0, -0.1)),
    ("The RMSE stays", {"holds": {"least_root_over_rmse": 1.1, "without_measurements": 0.9},
                        "holds_vacuously": {"least_root_over_rmse": 1.1, "without_measurements": 1.1},
                        "fails": {"least_root_over_rmse": 0.9}}),
    ("The cubature filter's RMSE", both("steps_above", 0, 1)),
    ("The fused RMSE", {"holds": {"steps_above": 0, "without_measurements": 1},
                        "holds_vacuously": {"steps_above": 0, "without_measurements": 0},
                        "fails": {"steps_above": 1}}),
    ("Measurements enhance", both("least_gain_of_a_node", 0.1, -0.1)),
    *[(start, BOUND) for start in ("A filter that takes", "The polytope", "The zero-mean", "Trace-optimal intersection",
                                   "Equal-weight", "The sequential central filter with the zero",
                                   "The sequential central filter with the poly")],
    ("Trace-optimal weights", {"holds": {"optimal": Sampled(1, 0.1), "equal": Sampled(2, 0.1)},
                               "fails": {"optimal": Sampled(2, 0.1), "equal": Sampled(1, 0.1)}}),
    ("The RMSE of cubature polytope", BELOW), ("The RMSE of cubature zero", BELOW), ("The RMSE of ci equal", BELOW),
    ("The variance bounds", {"holds": {"excess_printed": 0.0, "excess_strong": 0.0}, "fails": {"excess_strong": 0.1}}),
    ("A minus sign", {"holds": {"bound": 1.0, "possible": 0.9}, "fails": {"bound": 1.0, "possible": 1.1}}),
    ("P^xy from", both("relative_error", 0.0, 0.1)),
    ("One symbol", both("relative_gap", 0.0, 0.1)),
    ("The other reading", BOUND),
    ("The gain of Step 4", {"holds": {"factor_printed": 1.0, "factor_strong": 1.0}, "fails": {"factor_strong": 0.9}}),
    ("The fused estimate", both("largest_error", 0.0, 0.1)),
    ("The relay noise", both("printed_over_right_power", 1.0, 0.5)),
    ("The cross terms", both("trace_added", 0.0, 0.1)),
    ("x⁻ = f(x̂)", both("longest_offset", 0.0, 0.1)),
    ("The cubature covariance", both("least_eigenvalue_of_difference", 0.0, -0.1)),
    ("The Δ are", both("sum_of_probabilities_off_by", Sampled(0.01, 0.01), Sampled(0.04, 0.01))),
    ("𝔖₄", both("with_constant_gain", 0.0, 0.1)),
    ("RMSE and trace", both("mean_trace", 4.0, 16.0)),
    ("The example's state", both("rotor_growth_after_100_steps", 0.9, 1.1)),
]  # fmt: skip


def test_verdicts_follow_from_evidence(result):
    judged = [
        s._replace(evidence={**s.evidence, "mean_root": 4.0}) if s.text.startswith("RMSE and trace") else
        s._replace(evidence={**s.evidence, "papers": Sampled(1.0, 0.1)}) if "papers" in s.evidence else s
        for s in all_statements(result)
    ]  # fmt: skip
    check_verdicts(judged, VERDICTS)


def overstated(statistics):
    return replace(statistics, claimed_pairs=statistics.claimed_pairs / 4)


@pytest.mark.parametrize("runs", [0, 9, 64.5])
def test_too_few_runs_are_refused(runs):
    with pytest.raises(ValueError, match="runs: expected a whole number of at least 10"):
        cubature_fusion.Setting(runs=runs)


def test_a_folder_of_somebody_else_is_left_alone(tmp_path):
    folder = tmp_path / "cubature-fusion"
    folder.mkdir()
    (folder / "thesis.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"as they were written, got thesis\.txt, which would be lost"):
        cubature_fusion.run(cubature_fusion.Setting(runs=64), tmp_path)
    assert (folder / "thesis.txt").read_text() == "mine"
