"""Every public object is short to look at, equal to its copy by one answer, and goes through a pickle."""

import copy
import inspect
import pickle
from html.parser import HTMLParser
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph import fusion, model, random_affine, simulation

WIDE, LONG = 110, 10


def drive(x, u):
    return jnp.stack([x[0] + 0.1 * x[1], 0.9 * x[1] + u[0]])


def see(x):
    return jnp.sin(x)


PLANT = hg.Plant(drive, 0.1 * np.eye(2), [0, 0], np.eye(2), states=["p", "v"], inputs=["push"])
SENSOR = hg.Sensor(see, 0.1 * np.eye(2), outputs=["a", "b"])
LINEAR = hg.LinearPlant(0.9 * np.eye(2), np.eye(2), [0, 0], np.eye(2))
LOOK = hg.LinearSensor(np.eye(2), np.eye(2))
HOP = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.1)
LINK = hg.parallel([HOP, hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.1), HOP])])
BURSTS = hg.gilbert_elliott(hg.erasure(HOP, 0.9), hg.erasure(HOP, 0.1), 0.1, 0.5)
AWARE = hg.cubature_filter(PLANT, SENSOR, LINK)
NODES = {f"node {i}": hg.Node(SENSOR, LINK, {"aware": AWARE}) for i in range(3)}
OBJECTS = {
    "plant": PLANT,
    "sensor": SENSOR,
    "linear plant": LINEAR,
    "linear sensor": LOOK,
    "laws": (
        hg.random_affine.Rician(1.0, 2.0),
        hg.random_affine.Nakagami(1.0, 2.0),
        hg.random_affine.LogNormal(0.0, 0.3),
        random_affine.Constant(2.0),
    ),
    "link": LINK,
    "erasure": hg.erasure(HOP, 0.9),
    "bursts": BURSTS,
    "chain": hg.random_affine.MarkovChain([[0.9, 0.1], [0.5, 0.5]]),
    "over time": hg.model.over_time([PLANT, PLANT]),
    "noise": random_affine.FiniteSupport([[-1.0], [1.0]], [0.5, 0.5]),
    "quantizer": fusion.EscapeQuantizer(9, 1.0, 0.5, 0.5, 0.1),
    "filter": AWARE,
    "extended": hg.extended_filter(PLANT, SENSOR, LINK),
    "kalman": hg.kalman_filter(LINEAR, LOOK),
    "fusion": hg.Fusion("aware", hg.CovarianceIntersection()),
    "network": hg.Network(PLANT, NODES, {"all": hg.Fusion("aware", hg.fusion.EqualIntersection())}),
    "estimate": hg.model.Estimate(np.zeros(2), np.full((2, 2), np.nan), "none"),
    "innovation": model.Innovation(np.zeros(2), np.eye(2), np.array(0.0)),
    "large": hg.Network(PLANT, {f"n{i}": hg.Node(SENSOR, LINK, {}) for i in range(200)}),
}


class Tags(HTMLParser):
    """What opens must close."""

    def __init__(self):
        super().__init__()
        self.open, self.text = [], ""

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_is_short_equal_to_its_copy_and_pickled(name):
    for item in OBJECTS[name] if isinstance(OBJECTS[name], tuple) else (OBJECTS[name],):
        lines = repr(item).splitlines()
        assert len(lines) <= LONG + 1 and max(map(len, lines)) <= WIDE and type(item).__name__ in lines[0]
        page = Tags()
        page.feed(item._repr_html_())
        assert not page.open and type(item).__name__ in page.text
        for other in (copy.deepcopy(item), pickle.loads(pickle.dumps(item))):
            assert (item == other) is True
        assert (item == 3) is False and (item != copy.deepcopy(item)) is False


ROOMS = [name for name in hg.__all__ if inspect.ismodule(getattr(hg, name)) and name != "testing"]
CLASSES = [
    getattr(import_module(place), name)
    for place in ("heliograph", *(f"heliograph.{room}" for room in ROOMS))
    for name in import_module(place).__all__
    if inspect.isclass(item := getattr(import_module(place), name)) and not issubclass(item, Exception)
]


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_public_class_looks_that_way(kind):
    assert kind._repr_html_ and kind.__eq__ is hg.Plant.__eq__
    assert (kind.__repr__ is hg.Plant.__repr__) is (kind is not hg.Network)  # which is shown as a diagram


class Holder(random_affine.AbstractLaw):
    """A law of one's own, which may hold anything."""

    value: object

    def sample(self, key):
        return 1.0

    def moment(self, order):
        return 1.0


def same(one, other):
    return Holder(one) == Holder(other)


def test_equality_is_of_everything():
    assert same(np.array([1.0, np.nan]), np.array([1.0, np.nan])) and not same(np.ones(2), np.ones(2, dtype=np.float32))
    assert not same(np.ones((1, 2)), np.ones(2)) and not same([1], (1,)) and same({"a": 1, "b": 2}, {"b": 2, "a": 1})
    assert same(np.nan, float("nan")) and not same(1.0, 1) and not same({"a": 1}, {"b": 1})
    assert same(jax.random.key(3), jax.random.key(3)) and not same(jax.random.key(3), jax.random.key(4))
    assert hg.Rayleigh(0.8) != hg.Rayleigh(0.9) and hg.Rayleigh(0.8) != hg.random_affine.Rician(1.0, 0.8)
    item, two = (simulation.Uplink(("a",), np.zeros((2, 1, 2), dtype=bool), np.full((2, 1, 2), v)) for v in (1.0, 2.0))
    assert item != two and [item] == [copy.copy(item)] and item in [two, copy.deepcopy(item)]


def test_names_do_not_act_on_a_page_or_a_terminal():
    bad = "</table><script>\x1b[31m"
    network = hg.Network(PLANT, {bad: hg.Node(SENSOR, LINK, {bad: AWARE})})
    assert (
        "\x1b" not in repr(network) and "<script" not in network._repr_html_() and "\x1b" not in network._repr_html_()
    )


def test_long_things_are_counted_and_short():
    class Large(hg.files.EventTable):  # a readable class, and so are those made from it
        def __init__(self):
            self.values = list(range(1000))
            self._hidden = 1

    for i in range(30):
        setattr(Large, f"p{i}", i)
    item = Large()
    item.__dict__ |= {f"part{i}": np.zeros(9) for i in range(30)}
    assert repr(item).splitlines()[-2] == "  … 23 more" and "_hidden" not in repr(item)
    assert "… 992 more" in repr(item) and "11 more" in item._repr_html_()


def test_a_stream_goes_on_after_a_pickle():
    stream = hg.Stream(AWARE)
    stream.push([0.1, 0.2], [1.0])
    other = pickle.loads(pickle.dumps(stream))
    assert other == stream and "steps=1" in repr(other)
    assert other.push([0.3, np.nan], [0.5]) == stream.push([0.3, np.nan], [0.5])
    stream.push([0.3, np.nan], [0.5])
    assert other != stream


def test_a_timeline_goes_on_after_a_pickle():
    network = hg.Network(LINEAR, {"n": hg.Node(LOOK, hg.perfect(2), {"f": hg.kalman_filter(LINEAR, LOOK)})})
    timeline = hg.Timeline(network, window=3.0)
    assert timeline.push("n", 0, 2.0, [0.5, 0.1]) == "used"
    other = pickle.loads(pickle.dumps(timeline))
    assert other == timeline and repr(other) == repr(timeline) and len(repr(other).splitlines()) <= LONG + 1
    for item in (timeline, other):
        assert item.push("n", 1, 1.0, [0.2, 0.0], arrival=2.5) == "used"
    assert same(other.estimates(), timeline.estimates())
    timeline.push("n", 2, 3.0, [0.2, 0.0])
    assert other != timeline
