"""Public constructors and functions, given anything in place of anything: they work, or say in one line what is wrong.

The line names the thing, what was expected, and what came. States of filters, keys and what only the package makes for
itself are not tried.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph import campaign, cli, filters, fusion, linear, model, random_affine, relays, simulation
from tests.junk import COIN, ESCAPE, EYE, HOP, KALMAN, NODE, PLANT, SCALAR, SENSOR, check, name_of

KNOWN = hg.model.Estimate(np.zeros(2), EYE, "exact")
COINS = hg.LinearPlant([[0.9]], COIN, [0.0], 1.0), hg.LinearSensor([[1.0]], COIN)
RECEIVER = {"receiver": {"s": HOP}}, {"receiver": {"r": HOP}}
SLOTS = [{"r": {"sensor": HOP}, **RECEIVER[0]}, {"s": {"sensor": HOP}, **RECEIVER[1]}]
RELAYS = model.RelayNetwork(*SCALAR, ("r", "s"), SLOTS)
SINGLE = dict(zip(("plant", "sensor", "channel"), (*SCALAR, HOP), strict=True))
LINK = {"plant": PLANT, "sensor": SENSOR, "channel": HOP}
SYSTEM = linear.lifted_system(*SCALAR, HOP, 1, 3)
SCHEDULE = linear.lmmse(SYSTEM)
PRIOR = {"initial_mean": [0.0, 0.0], "initial_covariance": EYE}

NETWORK = hg.Network(PLANT, {"a": NODE})

CALLS = [  # what is called, and arguments with which it works
    (hg.Discrete, {"values": [1.0, 2.0], "probabilities": [0.5, 0.5], "radius": 0.0}),
    (hg.random_affine.LogNormal, {"log_mean": 0.0, "log_deviation": 1.0}),
    (hg.random_affine.Nakagami, {"shape": 1.0, "power": 1.0}),
    (hg.Rayleigh, {"scale": 1.0}),
    (hg.random_affine.Rician, {"sight": 1.0, "scale": 1.0}),
    (hg.Gaussian, {"covariance": EYE, "mean": [0.0, 0.0]}),
    (hg.LinearPlant, {"matrix": EYE, "noise": 0.1, **PRIOR, "input_matrix": [[1.0], [0.0]], "states": ["a", "b"],
                     "inputs": ["u"]}),
    (hg.Plant, {"transition": lambda x, u: x, "noise": 0.1 * EYE, **PRIOR, "states": ["a", "b"], "inputs": ["u"]}),
    (hg.LinearSensor, {"matrix": [[1.0, 0.0]], "noise": 0.1, "outputs": ["y"]}),
    (hg.Sensor, {"measure": lambda x: x[:1], "noise": 0.1, "outputs": ["y"]}),
    (hg.amplify_and_forward, {"hops": [HOP]}),
    (hg.dropout, {"channel": HOP, "arrival": 0.5, "radius": 0.0}),
    (hg.erasure, {"channel": HOP, "arrival": 0.5}),
    (hg.hop, {"gain": 1.0, "noise": 0.1, "power": 1.0, "amplification": 1.0, "dimension": 1}),
    (hg.parallel, {"channels": [HOP, HOP]}),
    (hg.perfect, {"dimension": 1}),
    (hg.model.with_direct_link, {"relayed": HOP, "direct": HOP}),
    (hg.model.over_time, {"items": [HOP, HOP]}),
    (hg.cubature_filter, {**LINK, "update": filters.Polytope(), **PRIOR}),
    (hg.extended_filter, LINK),
    (hg.mean_gain_filter, LINK),
    (hg.kalman_filter, {"plant": PLANT, "sensor": SENSOR, **PRIOR}),
    (hg.linear_filter, LINK),
    (hg.filters.open_loop_filter, {"plant": PLANT, **PRIOR}),
    (hg.polynomial_filter, {**SINGLE, "horizon": 3, "degree": 1}),
    (hg.filters.mixture_filter, {"plant": COINS[0], "sensor": COINS[1], "channel": hg.perfect(), "resolution": 0.0}),
    (hg.Fusion, {"filter": "f", "rule": hg.fusion.EqualIntersection(), "quantizer": ESCAPE}),
    (hg.Network, {"plant": PLANT, "nodes": {"a": NODE}, "fused": {"c": hg.Fusion("f", hg.fusion.EqualIntersection())}}),
    (hg.Network.of_relays, {"relays": RELAYS, "schedules": {}, "receivers": {}}),
    (hg.Node, {"sensor": SENSOR, "channel": hg.perfect(), "filters": {"f": KALMAN}}),
    (hg.Stream, {"filter": KALMAN}),
    (hg.Stream(KALMAN).push, {"measurement": [0.0], "inputs": ()}),
    (hg.log_likelihood, {"filter": KALMAN, "measurements": np.zeros((2, 1)), "inputs": None}),
    (model.mean_gain, {"channel": HOP}),
    (model.silent, {"outputs": 1, "inputs": 1, "noise": 0.1}),
    (model.OverTime, {"values": np.ones((3, 2))}),
    (model.with_bias, {"plant": SCALAR[0], "sensor": SCALAR[1], "bias": 0.5, "time": 2.0, "dt": 0.1}),
    (model.with_bias, {"plant": SCALAR[0], "sensor": SCALAR[1], "bias": SCALAR[0], "coupling": [[1.0]]}),
    (model.RelayNetwork, {"plant": SCALAR[0], "sensor": SCALAR[1], "relays": ("r", "s"), "slots": SLOTS}),
    (random_affine.GainAndNoise, {"law": hg.Rayleigh(1.0), "matrix": EYE, "noise": 0.1}),
    (random_affine.known, {"matrix": EYE}),
    (random_affine.Lift, {"base": HOP, "degree": 2}),
    (random_affine.DelayLine, {"link": random_affine.known([[0.5, 0.5]]), "past": 1}),
    (random_affine.Mixture, {"maps": [HOP, HOP], "weights": [0.5, 0.5], "radius": 0.0}),
    (random_affine.Series, {"maps": [HOP]}),
    (random_affine.Stack, {"maps": [HOP]}),
    (hg.superposed, {"links": [HOP, HOP], "noise": 0.1, "same": True}),
    (random_affine.Rotation, {"deviation": 0.3}),
    (random_affine.Superposed, {"maps": [HOP], "noise": COIN, "places": [(0,)], "inputs": 1}),
    (random_affine.square, {"base": HOP}),
    (random_affine.Constant, {"value": 1.0}),
    (random_affine.GivenMoments, {"moments": [0.0, 1.0]}),
    (random_affine.bernoulli, {"probability": 0.5}),
    (random_affine.NoiseMoments, {"moments": [0.0, 1.0, 0.0, 3.0]}),
    (random_affine.FiniteSupport, {"atoms": [[1.0], [-1.0]], "probabilities": [0.5, 0.5]}),
    (random_affine.Independent, {"parts": [COIN]}),
    (random_affine.Shaped, {"matrix": [[1.0], [2.0]], "source": COIN}),
    (random_affine.second_order, {"channel": HOP}),
    (linear.lifted_system, {**SINGLE, "degree": 1, "horizon": 3}),
    (linear.gain_over_linear, {**SINGLE, "horizon": 3}),
    (linear.lmmse, {"system": SYSTEM, "claim": "exact"}),
    (linear.true_covariance, {"system": SYSTEM, "schedule": SCHEDULE}),
    (linear.state_moments, {"system": SYSTEM}),
    (linear.Schedule, {"gains": SCHEDULE.gains, "start": SCHEDULE.start, "claim": "exact"}),
    (linear.LinearSystem, {"steps": SYSTEM.steps, "mean": SYSTEM.mean, "covariance": SYSTEM.covariance,
                          "projection": SYSTEM.projection}),
    (linear.load_schedule, {"path": "nothing.npz"}),
    (relays.local_error_design, {"network": RELAYS, "horizon": 2}),
    (relays.given_design, {"network": RELAYS, "gains": {}}),
    (relays.relay_schedules, {"network": RELAYS, "design": None}),
    (relays.receiver_behind_relays, {"network": RELAYS, "gains": {}}),
    (relays.receiver_error_design, {"network": RELAYS, "horizon": 2, "weights": None, "power_limit": None,
                                    "sweeps": 1}),
    (filters.Scalars, {"first": 1.0, "second": 1.0}),
    (filters.ZeroMean, {"scalar": 1.0}),
    (filters.PolynomialMoments, {"degree": 2}),
    (filters.gaussian_filter, {**LINK, "transform": filters.Cubature(), "update": filters.Polytope()}),
    (filters.sequential_filter, {"filters": [KALMAN]}),
    (filters.prediction_of, {"filter": KALMAN}),
    (filters.ScheduledFilter, {"schedule": SCHEDULE, "states": ["x"]}),
    (filters.LinearSystemFilter, {"system": SYSTEM, "states": ["x"]}),
    (filters.PolynomialFilter, {"inner": filters.ScheduledFilter(SCHEDULE), "degree": 1}),
    (filters.memory_filter, {**SINGLE, "horizon": 3}),
    (fusion.UniformQuantizer, {"levels": 8, "amplitude": 1.0, "scale": 1.0}),
    (fusion.EscapeQuantizer, {"levels": 9, "amplitude": 1.0, "decay": 0.5, "growth": 0.1, "smallest": 1e-3}),
    (ESCAPE.init, {"n": 1}),
    (fusion.FixedIntersection, {"weights": [0.5, 0.5]}),
    (fusion.WeightedFusion, {"weights": [0.5, 0.5]}),
    (fusion.level_weights, {"levels": [1.0, 2.0]}),
    (fusion.fused_level, {"levels": [1.0, 2.0], "weights": [0.5, 0.5]}),
    (fusion.fuse, {"rule": hg.fusion.EqualIntersection(), "estimates": [KNOWN] * 2}),
    (hg.monte_carlo, {"network": NETWORK, "horizon": 2, "runs": 2, "key": 0, "keep": hg.Statistics(), "inputs": None,
                      "chunk": 2048, "first_run": 0, "precision": "float64"}),
    (hg.run, {"network": NETWORK, "measurements": {"a": [0.0, 1.0]}, "inputs": None, "time": None}),
    (simulation.pool, {"statistics": []}),
    (campaign.load_campaign, {"path": "nothing.toml"}),
    (campaign.open_results, {"out": "nothing"}),
    (campaign.run_campaign, {"campaign": None, "out": "nothing"}),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")  # before it is refused
@pytest.mark.filterwarnings("ignore:.*got a JAX array of single precision")  # which is said, and used
@pytest.mark.parametrize(("call", "arguments"), CALLS, ids=[name_of(call) for call, _ in CALLS])
@settings(max_examples=25, derandomize=True)
@given(data=st.data())
def test_it_works_or_says_what_is_wrong(call, arguments, data):
    check(call, arguments, data)


WORDS = [
    *("run", "demo", "example", "reproduce", "sweep", "all", "cubature-fusion", "net.py", "net.py:network", "data.csv"),
    *(
        "campaign.toml",
        "--out",
        "o",
        "o.csv",
        "--seed",
        "--runs",
        "--set",
        "seed=2",
        "--workers",
        "--setting",
        "--chunk",
    ),
    *("--measurements", "--", "-1", "0", "3", "1" * 23, "150.7", "1_000", "nan", "", "\x1b[31m", "\0", "é", "--help"),
]


@settings(max_examples=150, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(words=st.lists(st.sampled_from(WORDS), max_size=7))
def test_any_command_line_ends_with_a_code_and_at_most_a_line(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    stub = SimpleNamespace(settings=lambda values: values, run=lambda *_: None)
    monkeypatch.setattr("heliograph.cli.studies.load_study", lambda entry: stub)  # what takes minutes is not run
    capsys.readouterr()
    code = cli.main(words)
    said = capsys.readouterr()
    assert code in (0, cli.BAD_INPUT)
    assert said.err == "" if code == 0 else said.err.startswith("heliograph: ") and said.err.count("\n") == 1
    assert all(c == "\n" or c.isprintable() for c in said.err)
