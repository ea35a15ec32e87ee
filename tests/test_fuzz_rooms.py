"""As test_fuzz.py, for what stands in rooms: designs for guarantees, memory, delays, clocks, smoothing, live data."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph import filters, fusion, h_infinity, linear, model, random_affine, relays, simulation, smoothing
from tests.junk import EYE, HOP, KALMAN, NODE, PLANT, SCALAR, SENSOR, check, name_of


class Later:
    """What is computed when it is first used, so that who only collects tests computes nothing."""

    def __init__(self, make):
        self.made = cache(make)

    def part(self, name):
        """An attribute of it."""
        return Later(lambda: getattr(self.made(), name))


def ready(arguments):
    """The arguments, computed."""
    return {name: value.made() if isinstance(value, Later) else value for name, value in arguments.items()}


NOISE = np.random.default_rng(0).normal(size=5000)
CHAIN = [[0.9, 0.1], [0.2, 0.8]]
BURST = hg.gilbert_elliott(HOP, hg.hop(0.5, 0.1), 0.1, 0.2)
SINGLE = dict(zip(("plant", "sensor", "channel"), (*SCALAR, HOP), strict=True))
NETWORK = hg.Network(PLANT, {"a": NODE, "b": NODE}, {"all": hg.Fusion("f", fusion.MatrixWeights())})
RECORD = Later(lambda: hg.monte_carlo(hg.Network(PLANT, {"a": NODE}), 3, 2, 0))
GROWTH = h_infinity.growth_system(
    3, [[0.2], [0.1]], [[0.3]], EYE, HOP, 0.0, transition=0.9 * EYE, output=[[1.0, 0.0]], initial_weight=5.0
)
START = 5.0 * np.eye(4)
DESIGN = Later(lambda: h_infinity.recursive_design(GROWTH, 5.0))
SLOT = {"r": {"sensor": HOP}, "receiver": {"r": HOP}}
PERIODIC = model.RelayNetwork(*SCALAR, ("r",), [SLOT])
LOCAL = Later(lambda: relays.periodic_local_error_design(PERIODIC))
CLOCKS = {"motion": [[0.0, 1.0], [0.0, 0.0]], "dt": 0.5, "clocks": {"b": model.Clock(0.5, 2e-3)}}
MOVING, SEEN = model.with_clocks(
    PLANT, {"a": SENSOR, "b": SENSOR}, **{k: CLOCKS[k] for k in ("clocks", "motion", "dt")}
)
PAIR = {"plant": MOVING, "sensor": model.joint_sensor(SEEN), "channel": hg.parallel([hg.perfect()] * 2)}

CALLS = [  # what is called, and arguments with which it works
    (hg.random_affine.MarkovChain, {"transition": CHAIN, "initial": [0.5, 0.5], "name": "c", "radius": 0.0}),
    (hg.gilbert_elliott, {"good": HOP, "bad": HOP, "fail": 0.1, "recover": 0.2, "name": "g"}),
    (hg.markov_plant, {"models": [PLANT, PLANT], "transition": CHAIN, "initial": [0.5, 0.5], "name": "m",
                       "modes": None}),
    (hg.markov_sensor, {"models": [SENSOR, SENSOR], "transition": CHAIN, "initial": [0.5, 0.5], "name": "m",
                        "modes": None}),
    (hg.markov_fading, {"gains": [1.0, 0.5], "transition": CHAIN, "noise": 0.1, "name": "m"}),
    (hg.model.autoregressive_fading, {"mean": 1.0, "deviation": 0.3, "correlation": 0.9, "noise": 0.1, "dimension": 1,
                                "name": "f"}),
    (hg.simulation.memory_test, {"data": np.ones((30, 1)), "filter": KALMAN, "inputs": None, "lags": 3}),
    (hg.simulation.transmit, {"signal": np.zeros((3, 1)), "channel": HOP, "seed": 0}),
    (hg.Timeline, {"network": NETWORK, "window": 3, "start": 0.0, "ahead": 0.0, "capacity": 8}),
    (model.Clock, {"offset": 0.5, "drift": 2e-3, "wander": 0.0}),
    (model.delayed, {"link": HOP, "delay": 1, "timestamped": False}),
    (model.with_clocks, {"plant": PLANT, "sensors": {"a": SENSOR, "b": SENSOR}, **CLOCKS}),
    (model.joint_sensor, {"sensors": {"a": SENSOR, "b": SENSOR}}),
    (model.with_flag, {"channel": BURST, "probabilities": EYE, "chain": None, "late": False}),
    (model.without_memory, {"channel": BURST}),
    (model.memory_matters, {"channel": BURST}),
    (random_affine.Autoregression, {"correlation": 0.9, "name": "a"}),
    (random_affine.Modes, {"chain": hg.random_affine.MarkovChain(CHAIN), "maps": [HOP, HOP]}),
    (random_affine.joint_modes, {"channel": BURST, "nodes": None, "order": 1}),
    (random_affine.recorded_noise, {"samples": NOISE, "order": 2}),
    (linear.critical_arrival, {"plant": PLANT, "sensor": SENSOR, "gain": None}),
    (relays.periodic_local_error_design, {"network": PERIODIC}),
    (relays.periodic_given_design, {"network": PERIODIC, "gains": LOCAL.part("gains")}),
    (relays.periodic_behind_relays, {"network": PERIODIC, "gains": LOCAL.part("gains")}),
    (h_infinity.growth_system, {"steps": 3, "disturbance": [[0.2], [0.1]], "feedthrough": [[0.3]], "target": EYE,
                                "channel": HOP, "growth": 0.1, "output_growth": 0.1, "transition": EYE,
                                "output": [[1.0, 0.5]], "initial_weight": 1.0}),
    (h_infinity.recursive_design, {"system": GROWTH, "level": 5.0, "initial": START, "objective": "trace",
                                   "solver": "clarabel", "separate": False}),
    (h_infinity.known_channel_design, {"system": GROWTH, "level": 5.0, "multipliers": None}),
    (h_infinity.certify_level, {"system": GROWTH, "gains": DESIGN.part("gains"), "weights": DESIGN.part("weights"),
                                "multipliers": DESIGN.part("multipliers"), "level": DESIGN.part("level"),
                                "growth": ()}),
    (h_infinity.check_growth, {"function": lambda x: 0.5 * x, "constant": 0.5, "low": [-1.0], "high": [1.0],
                               "name": "f", "seed": 0, "differences": True}),
    (h_infinity.h_infinity_filter, {"plant": PLANT, "sensor": SENSOR, "system": GROWTH, "design": DESIGN,
                                 "initial_mean": [0.0, 0.0]}),
    (filters.as_current_filter, SINGLE),
    (filters.late_filter, {"filter": KALMAN, "delay": 2}),
    (filters.part_filter, {"filter": KALMAN, "states": 1}),
    (filters.clock_filter, {**PAIR, "clocks": ["b"], "transform": filters.PolynomialMoments(2)}),
    *((f, {**SINGLE, "channel": BURST}) for f in
    (filters.side_information_filter, filters.imm_filter, filters.gpb1_filter,
                                               filters.gpb2_filter, filters.mode_known_filter,
                                               filters.mode_late_filter, filters.memoryless_filter)),
    (filters.particle_filter, {**SINGLE, "particles": 10, "seed": 0, "nodes": 3}),
    (filters.true_error, {"filter": KALMAN, "plant": PLANT, "sensor": SENSOR, "channel": hg.perfect(), "horizon": 3,
                          "inputs": None}),
    (smoothing.FixedLag, {"lag": 2}),
    (smoothing.FixedPoint, {"step": 1}),
    (smoothing.smoother_steps, {"filter": KALMAN, "measurements": np.zeros((3, 1)), "inputs": None, "first_step": 0}),
    *((rule, {"with_mean": False}) for rule in (fusion.MatrixWeights, fusion.DiagonalWeights, fusion.ScalarWeights)),
    (simulation.cross_covariances, {"network": NETWORK, "filter": "f", "horizon": 3, "inputs": None}),
    (simulation.fused_covariances, {"network": NETWORK, "horizon": 3, "inputs": None}),
    (simulation.error_statistics, {"record": RECORD, "node": "a", "name": "f"}),
    (simulation.arrivals, {"record": RECORD, "network": hg.Network(PLANT, {"a": NODE}), "run": 0}),
    (simulation.certify_boundedness, {"network": NETWORK}),
    (simulation.whitened_innovations, {"data": np.zeros((30, 1)), "filter": KALMAN, "inputs": None}),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("call", "arguments"), CALLS, ids=[name_of(call) for call, _ in CALLS])
def test_the_arguments_work(call, arguments):
    call(**ready(arguments))


@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")  # before it is refused
@pytest.mark.filterwarnings("ignore:.*got a JAX array of single precision")  # which is said, and used
@pytest.mark.parametrize(("call", "arguments"), CALLS, ids=[name_of(call) for call, _ in CALLS])
@settings(max_examples=15, derandomize=True)
@given(data=st.data())
def test_it_works_or_says_what_is_wrong(call, arguments, data):
    check(call, ready(arguments), data)
