"""Made-up evidence for each statement of H-infinity fusion, and the verdict that must follow."""

from heliograph_studies.statement import Sampled
from tests.studies.verdicts import both


def sampled(value, error=0.01):
    return Sampled(value, error)


SHARE = both("largest_share_of_runs", 0.0, 0.1)
DIFFERENCE = both("difference", sampled(-0.1), sampled(-0.02))
VERDICTS = [
    ("the inequalities", both("fewest_steps_certified", 16, 15)),
    ("the levels measure", {"holds": {"level_of_receiving_nothing": 2.0},
                            "holds_vacuously": {"level_of_receiving_nothing": 0.1}}),
    ("the smallest level", {"holds": {"best_gains": 0.9, "no_gains": 1.0}, "fails": {"best_gains": 1, "no_gains": 1}}),
    ("one multiplier", both("largest_ratio", 1.0, 1.01)),
    ("J_1", {"holds": {"largest": -1.0, "largest_without_measurements": 1.0},
             "holds_vacuously": {"largest": -1.0, "largest_without_measurements": -1.0}, "fails": {"largest": 1.0}}),
    ("J_2", {"holds": {"index": -1.0, "without_measurements": 1.0},
             "holds_vacuously": {"index": -1.0, "without_measurements": -1.0}, "fails": {"index": 1.0}}),
    ("the estimates track", {"holds": {"local": sampled(0.4), "without_measurements": sampled(1.0)},
                             "holds_vacuously": {"local": sampled(0.6), "without_measurements": sampled(1.0)}}),
    ("losses", both("standard_errors_off", 2.0, 5.0)),
    ("the fused error stays", {"holds": {"dynamic": sampled(1.1), "unquantized": sampled(1.0)},
                               "fails": {"dynamic": sampled(1.3), "unquantized": sampled(1.0)}}),
    ("dynamic quantization", DIFFERENCE),
    ("it does so", {"holds": {"printed": sampled(-1.0), "odd": sampled(-0.6)},
                    "fails": {"printed": sampled(-1.0), "odd": sampled(-0.4)},
                    "does_not_apply": {"printed": sampled(1.0), "odd": sampled(0.6)}}),
    ("v_s", both("first_divisor", 1.0, 0.0)),
    ("|f(x)| <=", both("largest_ratio", 0.7, 0.71)),
    ("|f(x) - f(xhat)|", {"holds": {"largest_slope": 0.7, "steps_that_break_it": 0},
                          "fails": {"largest_slope": 0.7, "steps_that_break_it": 1}}),
    ("the guarantee", {"holds": {"guaranteed": 1.0, "outcome": sampled(1.02)},
                       "fails": {"guaranteed": 1.0, "outcome": sampled(1.04)}}),
    ("levels can be", {"holds": {"largest_level": 1.0, "certified": 1}, "fails": {"certified": 0}}),
    ("(18)", both("gap", 0.0, 1e-3)),
    ("any solution", {"holds": {"nodes_stuck": 0, "nodes_stuck_with_an_objective": 0}, "fails": {"nodes_stuck": 1}}),
    ("(32)", both("least_divisor", 0.1, 0.0)),
    ("the fused level", both("level", 2.54192, 2.542)),
    ("the printed weights", {"holds": {"printed": 1.0, "best": 1.0}, "fails": {"printed": 1.1, "best": 1.0}}),
    ("the minimum", both("largest_eigenvalue", -0.1, 0.0)),
    ("fusing", {"holds": {"fused": 0.9, "best_node": 1.0}, "fails": {"fused": 1.1, "best_node": 1.0}}),
    ("|mu|", both("largest_ratio", 1.0, 1.1)),
    ("the quantization terms", SHARE),
    ("the fused error obeys", SHARE),
    ("the fusion centre", both("receiver_off_by", 0.0, 0.1)),
    ("the second example", both("not_certified", 0, 1)),
    ("H-infinity design", {
        "holds": {"guaranteed": 1.0, "statistics": sampled(1.1), "ignoring": sampled(1.1)},
        "fails": {"guaranteed": 1.0, "statistics": sampled(1.1), "ignoring": sampled(1.02)}}),
    ("it errs less under a resonant", DIFFERENCE),
    ("it errs less under white", DIFFERENCE),
    ("it errs less under a constant", DIFFERENCE),
    ("knowing A", {"holds": {"known": 0.4, "by_growth": 1.0}, "fails": {"known": 0.6, "by_growth": 1.0}}),
]  # fmt: skip
