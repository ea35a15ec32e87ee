"""Parts of the reproduction of H-infinity fusion that need none of its designs, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.h_infinity import slope_bounds
from heliograph_studies import h_infinity_fusion
from heliograph_studies.h_infinity_fusion import discriminating, example, levels, worst_disturbance
from heliograph_studies.h_infinity_fusion.setting import Setting, dynamics

pytestmark = pytest.mark.slow

pytest.importorskip("cvxpy")
SETTING = Setting()


def test_with_the_papers_start_only_the_start_counts():
    level = hg.h_infinity.horizon_design(SETTING.system(0), initial=10 * np.eye(4)).level
    assert level == pytest.approx(np.sqrt(10 / 15), rel=2e-6)  # (19), with the solver's margin


def test_theorem_1_survives_enumeration_and_the_enumeration_finds_a_wrong_term(monkeypatch):
    assert all(levels.enumeration_gap(SETTING, i) < 1e-14 for i in range(4))  # rounding
    honest = levels.make_theorem_matrix
    off = SETTING.system(1, hop=lambda uplink, noise: SETTING.lossy(uplink, noise if uplink else 1.01 * noise))
    monkeypatch.setattr(levels, "make_theorem_matrix", lambda system, *rest: honest(off, *rest))
    assert levels.enumeration_gap(SETTING, 1) > 1e-6  # one noise's variance 1 % too large


def test_the_growth_constant_is_false_for_differences_and_true_for_sizes(monkeypatch):
    monkeypatch.setattr(slope_bounds, "LIMIT", 256)  # boxes: of a slope above 15 no number proves 0.7
    f, side = dynamics(15), np.full(2, 2.0)
    result = hg.h_infinity.check_growth(f, 0.7, -side, side)
    assert result.refuted and 15 < result.ratio < 0.7 * np.sqrt(1 + (2 * 15) ** 2 + 1)  # below |J| for |x2| <= 2
    x, y = result.pair
    with jax.enable_x64(True):
        moved = np.linalg.norm(np.asarray(f(jnp.asarray(x))) - np.asarray(f(jnp.asarray(y))))
    assert moved / np.linalg.norm(x - y) == pytest.approx(result.ratio, rel=1e-9)
    assert not hg.h_infinity.check_growth(f, 0.7, -side, side, differences=False).refuted


def test_fused_levels():
    weights = hg.fusion.level_weights(SETTING.levels)
    np.testing.assert_allclose(weights, [0.248842, 0.278979, 0.248842, 0.223337], atol=5.1e-7)  # printed digits
    assert levels.published_fused_level(SETTING.levels, weights) == pytest.approx(2.539682, abs=5.1e-7)


def test_the_search_finds_the_norm_of_a_linear_system():
    """With phi = 0 and no gain, the largest ratio is a singular value."""
    rotation, steps = discriminating.ROTATION, discriminating.STEPS
    nothing = hg.h_infinity.GrowthSystem(*discriminating.system("1"))
    design = hg.h_infinity.HInfinityDesign(
        1.0, np.zeros((steps, 2, 2)), np.zeros((steps + 1, 4, 4)), np.zeros((steps, 2)), True, ""
    )

    def transition(x, u):
        return jnp.where(u[1] > 0, rotation @ x, x)

    plant = hg.Plant(transition, np.zeros((2, 2)), np.zeros(2), np.eye(2), inputs=discriminating.INPUTS)
    item = hg.h_infinity.h_infinity_filter(plant, discriminating.sensor("1"), nothing, design)
    world = worst_disturbance.World(
        lambda x, k: rotation @ x, lambda x: x[:1], discriminating.DISTURBANCE, np.zeros((1, 1)), np.eye(2), np.eye(4),
        discriminating.inputs("bias"),
    )  # fmt: skip
    draws = discriminating.LINKS.draws(2, 0)
    result = worst_disturbance.worst_disturbance(item, world, draws, draws, [1.0], rounds=200)
    powers = [np.linalg.matrix_power(rotation, k) for k in range(steps)]
    push = discriminating.DISTURBANCE
    toeplitz = np.block([
        [powers[k], *(powers[k - 1 - j] @ push if j < k else np.zeros((2, 1)) for j in range(steps))]
        for k in range(steps)
    ])  # fmt: skip
    top = np.linalg.svd(toeplitz, compute_uv=False)[0]
    assert result.level <= top * (1 + 1e-12) and result.level == pytest.approx(
        top, rel=1e-3
    )  # 200 rounds of power method


def test_the_second_example_is_certified_and_beats_a_kalman_filter_where_it_should():
    system = discriminating.system("1")
    design = hg.h_infinity.horizon_design(system, separate=True)
    side = np.full(2, discriminating.BOX)
    finding = hg.h_infinity.check_growth(discriminating.slight, discriminating.GROWTH, -side, side, "phi")
    assert not finding.refuted and levels.certify(system, design, [finding]).certified
    assert design.level == pytest.approx(7.2565, rel=1e-4)  # of which margins in a large system's units cost 1.7e-4
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(discriminating, "filters", lambda node, designs: {"ekf": kalman(node)})
        patch.setattr(discriminating, "ENERGIES", (1000.0,))
        patch.setattr(discriminating, "SEARCH_DRAWS", 16)
        patch.setattr(discriminating, "JUDGE_DRAWS", 1_000)
        worst = discriminating.worst_cases({})["ekf"]
    assert worst.level - 4 * worst.standard_error > design.level
    assert hg.h_infinity.horizon_design(discriminating.system("1", False), separate=True).level > 4 * design.level


def kalman(node):
    believed, sensor = discriminating.plant(False), discriminating.sensor(node)
    return example.prediction_of(hg.extended_filter(believed, sensor, discriminating.LINKS.unit_channel()))


@pytest.mark.parametrize("runs", [0, 99, 100.5])
def test_too_few_runs_are_refused(runs):
    with pytest.raises(ValueError, match="runs: expected a whole number of at least 100"):
        Setting(runs=runs)


@pytest.mark.parametrize(("segments", "odd"), [(20, 21), (21, 21), (40, 41)])
def test_quantizers_have_the_levels_of_the_setting_and_an_odd_number_where_zero_is_one(segments, odd):
    made = example.quantizers(Setting(runs=100, segments=segments))
    levels_of = {name: int(getattr(q, "uniform", q).levels) for name, q in made.items() if q is not None}
    assert levels_of == {
        "dynamic": segments, "static": segments, "dynamic_decodable": odd, "static_odd": odd,
    }  # fmt: skip


def test_a_folder_of_somebody_else_is_left_alone(tmp_path):
    (tmp_path / "h-infinity-fusion").mkdir()
    (tmp_path / "h-infinity-fusion" / "thesis.tex").write_text("mine")
    with pytest.raises(ValueError, match=r"got thesis\.tex, which would be lost"):
        h_infinity_fusion.run(Setting(runs=100), tmp_path)
