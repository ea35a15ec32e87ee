"""The committed results have the documented shape and follow from their numbers; the programs call what there is.

No timing here.
"""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/run.py, imported as it is when run."""
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module("run")


@pytest.fixture
def results() -> dict[str, Any]:
    collected: dict[str, Any] = json.loads((FOLDER / "results.json").read_text())
    return collected


def test_results_tell_where_and_when(results: dict[str, Any]) -> None:
    assert set(results) == {"date", "load", "machine", "threads", "comparisons", "alone"}
    assert set(results["machine"]) == {"cpu", "cores", "system", "python", "gflops", "gbytes"}


def test_results_hold_no_path(results: dict[str, Any]) -> None:
    text = json.dumps(results)
    assert "://" not in text and '"/' not in text and " /" not in text


def test_every_benchmark_is_in_the_results(bench: ModuleType, results: dict[str, Any]) -> None:
    assert set(results["comparisons"]) == set(bench.COMPARISONS)
    assert set(bench.ALONE) <= set(results["alone"]) <= {*bench.ALONE, *bench.WITH_PEERS}
    by_number = {"first_call_s", "again_s", "ns_per_node_step_run", "ns_per_node_step_run_erased", "old_release"}
    for name, result in results["alone"].items():
        expected = {"unit", "values", "at_most", "met"} | (by_number if name == "nodes" else set())
        assert set(result) | {"old_release"} == expected | {"old_release"}
    for name, item in bench.COMPARISONS.items():
        result = results["comparisons"][name]
        assert set(result) - {"old_release"} == {"title", "unit", "runs", "steps", "floor", "distance", "ours", "peers"}
        assert set(result["ours"]) == {"best", "median", "how", "processors", "runs", "versions"}
        assert {title: peer.get("target") for title, peer in result["peers"].items()} == {
            peer.title: peer.target for peer in item.peers
        }


def test_ratios_and_verdicts_follow_from_the_times(bench: ModuleType, results: dict[str, Any]) -> None:
    for name, item in bench.COMPARISONS.items():
        result, agreement = results["comparisons"][name], {peer.title: peer.agreement for peer in item.peers}
        for title, peer in result["peers"].items():
            # Times and ratio are written with two decimals; the smallest time here is tens of nanoseconds.
            assert peer["ratio"] == pytest.approx(peer["best"] / result["ours"]["best"], abs=0.01, rel=1e-3)
            assert peer["met"] == (None if peer["target"] is None else peer["ratio"] >= peer["target"])
            assert peer["difference"] is None or peer["difference"] <= agreement[title]
    for result in results["alone"].values():
        assert result["met"] == {key: result["values"][key] <= most for key, most in result["at_most"].items()}


def test_only_a_peer_that_computes_something_else_is_not_compared(bench: ModuleType, results: dict[str, Any]) -> None:
    for name, item in bench.COMPARISONS.items():
        for peer in item.peers:
            assert (results["comparisons"][name]["peers"][peer.title]["difference"] is None) is not peer.same


def test_a_peer_that_disagrees_ends_the_run(bench: ModuleType) -> None:
    bench.check_agreement("peer", bench.AGREEMENT)
    for gap in (2 * bench.AGREEMENT, float("nan")):
        with pytest.raises(SystemExit, match="peer: expected our estimates within"):
            bench.check_agreement("peer", gap)


def test_a_step_s_least_work_is_that_of_a_scalar_by_hand(bench: ModuleType) -> None:
    # One state, one measurement: a m, a P, (a P) a, + q | g c, h P, (h P) h, + r | two solves | z - h m, m + k e,
    # P - k h P; products and sums counted apart: 2 + 2 + 2 + 1, 1 + 2 + 2 + 1, 2, 2 + 2 + 2.
    assert bench.problems.kalman_flops(1, 1) == 21


def test_a_sweep_back_s_least_work_is_that_of_a_scalar_by_hand(bench: ModuleType) -> None:
    # B l - w e: 2 + 2, B L B + w h: 2 + 2 + 2 + 1 | A l, A L A: 2 + 2 + 2 | x - P l: 2 + 1, P - P L P: 2 + 2 + 1.
    assert bench.problems.smoothing_flops(1, 1) == 11 + 6 + 8
    assert bench.problems.smoothed_mean_flops(1, 1) == 2 + 4 + 2 + 2 + 2 + 1


def test_several_modes_cost_as_many_steps_and_their_mixtures(bench: ModuleType) -> None:
    # One mode: its step, the likelihood (2 + 1 + 2) and three more of the weights, one product, two mixtures of one
    # Gaussian with one state (2 + 1 + 2 each).
    assert bench.problems.modes_flops(1, 1, 1) == 21 + 5 + 3 + 1 + 2 * 5


def test_the_drawn_problems_fit_their_models(bench: ModuleType) -> None:
    p = bench.problems.cubature(runs=4_000, steps=1).arrays
    x = bench.problems.START
    moved = np.array(bench.problems.transition(x))
    # E z = mu C f(x_0) up to the curvature of f (below 1e-3); 4,000 draws of spread 1.05 have a standard error of
    # 0.017, of which 0.08 is nearly five.
    assert p["z"][:, 0].mean(axis=0) == pytest.approx(p["gain"] * p["C"] @ moved, abs=0.08)


LAX = (  # types alone, not names and calls; and peers that are installed nowhere
    "union-attr",
    "arg-type",
    "assignment",
    "misc",
    "method-assign",
    "return-value",
    "import-not-found",
    "import-untyped",
)
STRICT = (  # what is asked of the library alone
    "strict_optional", "check_untyped_defs", "disallow_any_generics", "disallow_subclassing_any",
    "disallow_untyped_calls", "disallow_untyped_decorators", "disallow_untyped_defs", "disallow_incomplete_defs",
    "strict_equality", "extra_checks", "warn_return_any", "warn_unused_ignores",
)  # fmt: skip


@pytest.mark.slow
def test_every_benchmark_calls_what_there_is(tmp_path: Path) -> None:
    """Nothing else runs these programs, and a renamed function would be found by whoever wants to measure.

    The library is checked by the settings of `make test`, so that what that wrote into .mypy_cache is read here.
    """
    root, files = FOLDER.parent, sorted(FOLDER.glob("*.py"))
    names = [
        *(path.stem for folder in (FOLDER, FOLDER / "peers") for path in folder.glob("*.py")),
        "peers.*",
        "programs.*",
    ]
    settings = [f"{name} = false" for name in STRICT]
    override = ["[[tool.mypy.overrides]]", f"module = {names}", *settings, f"disable_error_code = {list(LAX)}"]
    config = tmp_path / "pyproject.toml"
    config.write_text("\n".join([(root / "pyproject.toml").read_text(), *override]))
    completed = subprocess.run(
        [
            sys.executable,
            "-m",
            "mypy",
            "--strict",
            f"--config-file={config}",
            *(f"benchmarks/{path.name}" for path in files),
        ],
        cwd=root,
        env=os.environ | {"MYPYPATH": os.pathsep.join(map(str, (FOLDER, FOLDER / "peers", root / "src")))},
        capture_output=True,
        text=True,
    )
    assert not [line for line in completed.stdout.splitlines() if line.startswith("benchmarks/")], completed.stdout
    assert "checked" in completed.stdout
