"""Every public name, given anything: a name is tried by being there, with samples that its parameters' names ask for.

A parameter without a sample here is given anything at all. What is called with arguments that work, one replaced,
stands in test_fuzz.py and test_fuzz_rooms.py.
"""

import inspect
from importlib import import_module
from os import chdir
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

import heliograph as hg
from heliograph import fusion, planning
from tests import test_fuzz, test_fuzz_rooms
from tests.junk import EYE, HOP, JUNK, KALMAN, NODE, PLANT, SCALAR, SENSOR, judged
from tests.test_structure import PUBLIC

NETWORK = hg.Network(PLANT, {"a": NODE, "b": NODE}, {"all": hg.Fusion("f", fusion.MatrixWeights())})
PATHS = planning.independent_paths([[0.9]], [[0.1]], [[1.0]], [0.1], [1.0], [1.0])
SAMPLES = {  # what a parameter of this name usually is
    "plant": SCALAR[0], "sensor": SCALAR[1], "channel": HOP, "link": HOP, "network": NETWORK, "horizon": 3,
    "degree": 1, "filter": KALMAN, "filters": [KALMAN], "item": KALMAN, "noise": 0.1,
    "law": hg.Rayleigh(1.0), "matrix": EYE, "transition": 0.9 * EYE, "process": 0.1 * EYE, "covariance": EYE,
    "mean": [0.0, 0.0], "claim": "exact", "initial_mean": [0.0, 0.0], "initial_covariance": EYE,
    "sensors": {"a": SENSOR}, "rows": [[1.0, 0.0]], "noises": [0.1], "measurements": np.zeros((3, 1)),
    "data": np.zeros((30, 1)), "inputs": None, "weights": [0.5, 0.5], "levels": [1.0, 2.0], "paths": PATHS,
    "powers": [1.0], "budget": 1.0, "target_error": 0.5, "alpha": [1.0], "kappa": [1.0], "total": 1.0,
    "fates": [1, 1, 0, 1], "sequence": [0, 1, 3], "arrived": np.ones((3, 1)), "payload": b"{}",
    "path": "nothing.csv", "table": {"time": [0.0, 1.0]}, "columns": {"time": np.zeros(2)},
    "url": "mqtt://host/topic", "rule": fusion.EqualIntersection(), "rho": 0.5, "exponent": 2.0,
    "function": lambda x: 0.5 * x, "delay": 1, "lag": 1, "step": 1, "seed": 0, "estimate": None, "base": HOP,
    "maps": [HOP], "relays": ("r",), "joint": np.eye(4), "count": 1, "states": 1,
}  # fmt: skip
PROTOCOLS = ("Transport", "Broker")
WITH_PEERS = {  # what is no function of its arguments alone
    "connected",  # goes on trying to reach the broker at an address
    "keep_running",  # a coroutine that ends with its transport's messages
    "serve_until",  # the same until an event
    "check_transport",  # waits for a broker's messages
    "Pipe",  # reads the file of any number that it is given, that of this process's standard input too
    "keep_compilations",  # changes where JAX keeps programs, of all tests after it
    "show_progress",  # writes to the terminal until its block ends
}
TRACED = {"at", "gaussian_innovation", "mixed_innovation"}  # stand inside a filter that has checked what it was given
RESULTS = {"StatisticsByName"}  # made by the package alone, from what it has checked
WITH_ARGUMENTS = {getattr(call, "__name__", "") for call, _ in test_fuzz.CALLS + test_fuzz_rooms.CALLS}


def tried(place, name):
    """Whether a public name is something to call that is not called elsewhere."""
    item = getattr(import_module(place), name)
    if not callable(item) or inspect.isabstract(item) or name in WITH_PEERS | TRACED | RESULTS | WITH_ARGUMENTS:
        return False
    # A contract's check fails by AssertionError; a message's model is read by the service, which has the words.
    if place == "heliograph.testing" or (inspect.isclass(item) and issubclass(item, BaseModel)):
        return False
    # What others derive from does nothing itself; a tuple of results and an error hold whatever they are given.
    made = inspect.isclass(item) and (name.startswith("Abstract") or name in PROTOCOLS)
    return not made and not (inspect.isclass(item) and issubclass(item, tuple | Exception))


NAMES = [pair for pair in PUBLIC if tried(*pair)]


@st.composite
def arguments_of(draw, item):
    """Samples where there are some, one of them replaced, and anything elsewhere."""
    parameters = [
        p for p in inspect.signature(item).parameters.values() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]
    if not parameters:
        return {}
    replaced = draw(st.sampled_from([p.name for p in parameters]), label="argument")
    needed = [p for p in parameters if p.default is p.empty or p.name == replaced]
    samples = (
        SAMPLES
        if draw(st.booleans())
        else SAMPLES | draw(st.dictionaries(st.sampled_from(sorted(SAMPLES)), JUNK, max_size=1))
    )
    return {p.name: draw(JUNK) if p.name == replaced or p.name not in samples else samples[p.name] for p in needed}


@pytest.fixture(autouse=True, scope="module")
def _elsewhere(tmp_path_factory):
    """A path may be anything."""
    before = Path.cwd()
    chdir(tmp_path_factory.mktemp("anywhere"))
    yield
    chdir(before)


@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")  # before it is refused
@pytest.mark.filterwarnings("ignore:.*got a JAX array of single precision")  # which is said, and used
@pytest.mark.parametrize(("place", "name"), NAMES, ids=lambda part: part.removeprefix("heliograph."))
@settings(max_examples=15, derandomize=True)
@given(data=st.data())
def test_it_works_or_says_what_is_wrong(place, name, data):
    item = getattr(import_module(place), name)
    judged(item, data.draw(arguments_of(item), label="arguments"))
