"""What is made of models has every property of theirs: one table of all helpers of docs/names.md, and of properties."""

import inspect
import re
from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.model.over_time import at
from heliograph.model.plant import JointNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.memories_of_channels import memories

PAGE = Path(__file__).parents[2] / "docs" / "names.md"
KINDS = (
    "AbstractPlant|AnyPlant|LinearPlant|Plant|AbstractSensor|AnySensor|LinearSensor|Sensor|Node|Network|Channel|Delayed|"
    r"AbstractRandomAffine|GainAndNoise|Erasure|Mixture|Series|Stack|Modes|OverTime|\w*Filter"
)
MODEL = re.compile(rf"\b({KINDS})\b")


def unit_of(name):
    """The unit of a name of a state, output or input; none of plain text."""
    return getattr(name, "unit", "")


def public():
    """Every function and class of the page, by its name as it is written."""
    room = ""
    for line in PAGE.read_text().splitlines():
        room = line.removeprefix("## ") if line.startswith("## ") else room
        if row := re.match(r"\| `(\w+)` \|", line):
            place = room.replace("hg", "heliograph", 1) if room.startswith("hg") else room
            yield f"{room}.{row[1]}", getattr(import_module(place), row[1])


def takes_and_makes_models(item):
    try:
        signature = inspect.signature(item)
    except (TypeError, ValueError):
        return False
    made = item.__name__ if inspect.isclass(item) else str(signature.return_annotation)
    taken = " ".join(str(parameter.annotation) for parameter in signature.parameters.values())
    return bool(MODEL.search(made) and (MODEL.search(taken) or "over" in item.__name__.lower()))


# Models with every property: an angle and a number on a line, units, inputs, laws that are no Gaussian, limits.
STATES, INPUTS, OUTPUTS = {"turn": "rad", "way": "m"}, {"dt": "s"}, {"course": "rad", "range": "m"}
LAW = hg.random_affine.Independent([hg.Contaminated(0.01, 0.1, 1.0), hg.Gaussian([[0.1]])])
START = hg.random_affine.Independent([hg.Gaussian([[0.01]]), hg.Contaminated(0.1, 0.2, 2.0)])
NAMED, LIMITS = {"states": STATES, "inputs": INPUTS}, {"way": (-9.0, None)}
LINEAR = hg.LinearPlant(np.eye(2), LAW, [0.0, 1.0], START, [[1.0], [0.5]], circular=["turn"], **NAMED)
VARYING = hg.LinearPlant(lambda u: jnp.eye(2) + u[0] * jnp.eye(2, k=1) * 0.0, lambda u: u[0] * jnp.eye(2), [0.0, 1.0],
                         START, circular=["turn"], **NAMED)  # fmt: skip
CURVED = hg.Plant(lambda x, u: jnp.stack([x[0] + u[0], x[1] + jnp.cos(x[0])]), LAW, [0.0, 1.0], START,
                  circular=["turn"], **NAMED)  # fmt: skip
LIMITED, LIMITED_CURVED = (  # beside the others, since not every filter takes limits
    hg.LinearPlant(np.eye(2), LAW, [0.0, 1.0], START, [[1.0], [0.5]], circular=["turn"], limits=LIMITS, **NAMED),
    hg.Plant(lambda x, u: jnp.stack([x[0] + u[0], x[1] + jnp.cos(x[0])]), LAW, [0.0, 1.0], START, circular=["turn"],
             limits=LIMITS, **NAMED))  # fmt: skip
SEEN = hg.LinearSensor(np.eye(2), LAW, OUTPUTS, ["course"])
BENT = hg.Sensor(lambda x: jnp.stack([x[0], jnp.exp(x[1])]), LAW, OUTPUTS, ["course"])
PLAIN = hg.LinearPlant(np.eye(2), 0.1, [0.0, 1.0], 1.0, [[1.0], [0.5]], circular=["turn"], **NAMED)  # Gaussian
COMPASS = hg.LinearSensor(np.eye(2), 0.1, OUTPUTS, ["course"])
LINE, LIMITED_LINE = (
    hg.LinearPlant(np.eye(2), LAW, [0.0, 1.0], START, [[1.0], [0.5]], limits=limits, **NAMED) for limits in ((), LIMITS)
)  # without angles
ON_LINE = hg.LinearSensor(np.eye(2), LAW, OUTPUTS)
CLEAN, NOISY = hg.perfect(2), hg.hop(1.0, np.diag([0.1, 0.2]))
LOSSY = hg.erasure(NOISY, 0.8)
BURSTS = hg.gilbert_elliott(NOISY, hg.hop(1.0, np.eye(2)), 0.1, 0.2, "weather")
UNSURE = hg.random_affine.Mixture([CLEAN, NOISY], [0.5, 0.5], 0.1)
CUBATURE = hg.cubature_filter(CURVED, BENT, NOISY)


# The rules: what must hold of what is made, for something of which it is made and that begins at `start` in it.
def names_of(model):
    return model.outputs if isinstance(model, hg.model.AbstractSensor) else model.states


def named(made, of, start):
    for old, new in zip(names_of(of), names_of(made)[start:], strict=False):
        assert str(old) in str(new)
        assert unit_of(new) == unit_of(old)


def inputs(made, of, start):
    if not isinstance(of, hg.model.AbstractSensor):
        assert made.inputs == of.inputs and [*map(unit_of, made.inputs)] == [*map(unit_of, of.inputs)]


def angles(made, of, start):
    assert [i - start for i in made.angles if start <= i < start + len(names_of(of))] == list(of.angles)


def linear(made, of, start):
    for kind in (hg.LinearPlant, hg.LinearSensor):
        assert isinstance(made, kind) or not isinstance(of, kind)


def laws(made, of, start):
    """Moments of the noise and of the initial state up to the fourth, of each component."""
    size, total = len(names_of(of)), len(names_of(made))
    pairs = [(of.noise, made.noise)]
    if not isinstance(of, hg.model.AbstractSensor):
        u = jnp.array([0.3])
        np.testing.assert_allclose(made.noise_mean()[start : start + size], of.noise_mean(), atol=1e-15)
        part = slice(start, start + size)
        np.testing.assert_allclose(made.noise_covariance(u)[part, part], of.noise_covariance(u), rtol=1e-12)
        np.testing.assert_allclose(np.asarray(made.initial_mean)[part], of.initial_mean)
        np.testing.assert_allclose(np.asarray(made.initial_covariance)[part, part], of.initial_covariance, rtol=1e-12)
        pairs.append((of.deviation, made.deviation))
    for old, new in pairs:
        if isinstance(new, JointNoise):  # of parts, one of which depends on inputs
            assert old is new.plants[0].noise
            continue
        for i in range(size) if isinstance(old, hg.random_affine.AbstractNoise) else ():
            powers = 4 * np.eye(total, dtype=int)[start + i]
            assert new.moment(tuple(powers)) == pytest.approx(old.moment(tuple(4 * np.eye(size, dtype=int)[i])))


def limits(made, of, start):
    if not isinstance(of, hg.model.AbstractSensor):
        carried = dict(made.limits)
        assert [carried[str(names_of(made)[start + names_of(of).index(name)])] for name, _ in of.limits] == [
            ends for _, ends in of.limits]  # fmt: skip


MODELS = (named, inputs, angles, linear, laws, limits)


def an_angle(made, of, start):
    """The first number that is sent is an angle; so is what arrives of it."""
    assert made.carry_angles((start,))


def knows_losses(made, of, start):
    assert made.erases or not of.erases


def remembers(made, of, start):
    if made.remembers:  # else it was asked to forget
        assert {m.name for m in memories(of).values()} <= {m.name for m in memories(made).values()}


def is_unsure(made, of, start):
    if of is UNSURE:
        assert made.corner_count() > 1


CHANNELS = (an_angle, knows_losses, remembers, is_unsure)


def of_filter(made, of, start):
    assert made.states == of.states[: len(made.states)] and made.inputs == of.inputs
    assert [*map(unit_of, made.states)] == [*map(unit_of, of.states)][: len(made.states)]
    assert [*map(unit_of, made.inputs)] == [*map(unit_of, of.inputs)]
    if isinstance(of, hg.filters.AbstractFilter):
        expected = of.angles_used()
        assert made.angles_used().states == tuple(i for i in expected.states if i < len(made.states))
        assert made.angles_used().received[: len(expected.received)] == expected.received
        assert hg.model.weakest([made.claim, of.claim]) == made.claim
    elif of.angles:
        assert made.angles_used().states == of.angles


def of_network(made, of, start):
    """Limits and codes of nodes, and who decides when to send."""
    for name, node in of.nodes.items():
        if getattr(node, "limits", None) is not None:
            np.testing.assert_array_equal(made.nodes[name].limits.invalid, node.limits.invalid)
            if made.nodes[name].channel == node.channel:
                assert made.nodes[name].limits == node.limits
        assert getattr(made.nodes[name], "trigger", None) == getattr(node, "trigger", None)
    assert made.states == of.states and [*map(unit_of, made.states)] == [*map(unit_of, of.states)]


# The helpers: of each, what is made with what it is made of, and where that begins.
def joint():
    for parts in ({"a": SEEN, "b": SEEN}, {"a": BENT, "b": SEEN}, {"a": SEEN, "b": BENT}):
        made = hg.model.joint_sensor(parts)
        for i, part in enumerate(parts.values()):
            if part is BENT or BENT not in parts.values():  # beside one that is not linear, none is
                yield made, part, 2 * i
    assert hg.model.joint_sensor({"a": SEEN, "b": BENT}).circular == ("a_course", "b_course")


def clocks():
    wrong = {"b": hg.model.Clock(0.1, 0.01, 0.001)}
    for plant in (LINEAR, VARYING, CURVED, LIMITED, LIMITED_CURVED):
        for dt in (0.5, "dt"):
            made, sensors = hg.model.with_clocks(plant, {"a": SEEN, "b": BENT}, wrong, np.zeros((2, 2)), dt)
            yield from ((made, plant, 0), (sensors["a"], SEEN, 0), (sensors["b"], BENT, 0))
            assert unit_of(made.states[2]) == ("s" if dt == "dt" else "")


def biases():
    drifting = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, states={"offset": "rad"}, circular=["offset"])
    as_driven = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, [[0.0]], {"offset": "rad"}, INPUTS, ["offset"])
    for plant in (LINEAR, VARYING, CURVED, LIMITED, LIMITED_CURVED):
        for sensor in (SEEN, BENT):
            for arguments in ((0.1, 5.0), (0.1, 5.0, "dt"), (drifting, np.inf, 1.0, [[1.0], [0.0]])):
                made, biased = hg.model.with_bias(plant, sensor, *arguments)
                yield from ((made, plant, 0), (biased, sensor, 0))
                if arguments[0] is not drifting:
                    assert [*map(unit_of, made.states[2:])] == ["rad", "m"]  # of the outputs
                elif plant is LINEAR:
                    yield made, as_driven, 2


def joined():
    other = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, [[0.0]], {"offset": "rad"}, INPUTS, ["offset"])
    for plant in (LINEAR, VARYING, CURVED, LIMITED, LIMITED_CURVED):
        made = hg.models.join([plant, other])
        yield from ((made, plant, 0), (made, other, 2)) if plant is LINEAR else ((made, plant, 0),)


def past():
    late = hg.hop(1.0, np.eye(2), delay=hg.Discrete([0.0, 1.0], [0.5, 0.5]))
    yield hg.model.with_past(LIMITED_LINE, ON_LINE, late)[0], LIMITED_LINE, 0
    made, sent, _ = hg.model.with_past(LINE, ON_LINE, late)
    yield made, LINE, 0
    assert [unit_of(name) for name in (*made.states[2:], *sent.outputs)] == ["rad", "m"] * 4
    assert isinstance(sent, hg.LinearSensor)


def at_steps():
    for model in (LINEAR, CURVED, LIMITED, LIMITED_CURVED, SEEN, BENT):
        for varying in (hg.model.over_time([model, model]), hg.model.OverTime(hg.model.over_time([model]).values)):
            yield at(varying, 0), model, 0


def one(make, *channels):
    """Channels made of each of these."""
    return lambda: [(make(channel), channel, 0) for channel in channels or (CLEAN, NOISY, LOSSY, BURSTS, UNSURE)]


def over(make):
    """Filters made of filters."""
    bases = (lambda: CUBATURE, lambda: hg.kalman_filter(LINEAR, SEEN), lambda: hg.extended_filter(CURVED, BENT))
    return lambda: [(make(base()), base(), 0) for base in bases]


def of_parts(make, plant=CURVED, sensor=BENT, channel=NOISY):
    """A filter of a plant."""
    return lambda: [(make(plant, sensor, channel), plant, 0)]


def on_line(make, channel=NOISY):
    """A filter of a plant, which refuses angles."""

    def made():
        plant, sensor = (hg.LinearPlant(np.eye(2), 0.1, [0.0, 1.0], 1.0, states=STATES),
                         hg.LinearSensor(np.eye(2), 0.1, OUTPUTS))  # fmt: skip
        angular = hg.LinearPlant(np.eye(2), 0.1, [0.0, 1.0], 1.0, states=STATES, circular=["turn"])
        with pytest.raises(ValueError, match=r"angles|circular"):
            make(angular, sensor, channel)
        return [(make(plant, sensor, channel), plant, 0)]

    return made


def designed():
    plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, states={"level": "m"})
    sensor, link = hg.LinearSensor([[1.0]], 0.1, {"read": "m"}), hg.hop(hg.Rayleigh(0.8), 0.1)
    limits = {"limits": (-9.0, 9.0), "invalid": -99.0}
    network = hg.Network(plant, {name: hg.Node(sensor, link, {}, **limits) for name in "ab"})
    error = hg.planning.Error()
    powers = {hg.planning.paths_of(network, error)[0].names[0]: [2.0]}
    made = hg.planning.designed_network(network, powers, error)
    assert made.nodes["a"].limits.high == np.inf and made.nodes["b"].limits == network.nodes["b"].limits
    yield made, network, 0


def meshed():
    node = hg.Node(ON_LINE, NOISY, {"f": hg.linear_filter(LINE, ON_LINE, NOISY)}, (-9.0, 9.0), -99.0)
    fusion = hg.Fusion("f", hg.fusion.MatrixWeights(), neighbours={"a": ["b"], "b": ["a"]})
    network = hg.Network(LINE, {"a": node, "b": node}, {"m": fusion})
    arrived = hg.simulation.mesh_arrivals(network, "m", 5, 0)
    yield hg.simulation.freeze(network, "m", arrived, 5, np.ones((5, 1))), network, 0


def one_node():
    plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, states={"level": "m"})
    sensor, link = hg.LinearSensor([[1.0]], 0.1, {"read": "m"}), hg.hop(hg.Rayleigh(0.8), 0.1)
    filters = {"f": hg.linear_filter(plant, sensor, link)}
    nodes = {"a": hg.Node(sensor, link, filters, (-9.0, 9.0), -99.0), "b": hg.Node(sensor, link, filters)}
    fusion = hg.Fusion("f", hg.CovarianceIntersection(), neighbours={"a": ["b"], "b": ["a"]})
    network = hg.Network(plant, nodes, {"m": fusion})
    yield hg.simulation.node_network(network, "a"), network, 0


def centre():
    f = hg.linear_filter(LINE, ON_LINE, NOISY)
    network = hg.Network(LINE, {n: hg.Node(ON_LINE, NOISY, {"f": f}) for n in "ab"},
                         {"all": hg.Fusion("f", hg.fusion.AllReports())})  # fmt: skip
    yield hg.simulation.centre_filter(network, "all"), LINE, 0


def sequential():
    made = hg.filters.sequential_filter([CUBATURE, CUBATURE])
    assert made.angles_used().received == (0, 2)
    yield made, CUBATURE, 0


def clocked():
    plant, sensors = hg.model.with_clocks(CURVED, {"a": BENT}, {"a": hg.model.Clock(0.1, 0.01)}, np.zeros((2, 2)), 0.5)
    yield hg.filters.clock_filter(plant, sensors["a"], NOISY, ["a"]), plant, 0


RULER = hg.Words(8, -9.0, 9.0)
FLAGGED = hg.markov_fading([NOISY, hg.hop(1.0, np.eye(2))], [[0.9, 0.1], [0.2, 0.8]])
HELPERS = {
    "hg.model.joint_sensor": joint, "hg.model.with_clocks": clocks, "hg.model.with_bias": biases,
    "hg.model.with_past": past, "hg.models.join": joined, "hg.model.over_time": at_steps, "hg.model.OverTime": at_steps,
    # Channels of channels.
    "hg.amplify_and_forward": one(lambda c: hg.amplify_and_forward([CLEAN, c])),
    "hg.dropout": lambda: [],  # its zero is no angle, and is refused
    "hg.erasure": one(lambda c: hg.erasure(c, 0.9)),
    "hg.gilbert_elliott": one(lambda c: hg.gilbert_elliott(c, NOISY, 0.1, 0.2), CLEAN, NOISY, LOSSY),
    "hg.markov_fading": one(lambda c: hg.markov_fading([c, NOISY], [[0.9, 0.1], [0.2, 0.8]]), CLEAN, NOISY, LOSSY),
    "hg.parallel": one(lambda c: hg.parallel([c, hg.model.delayed(NOISY, 1)])),
    "hg.shared": one(lambda c: hg.shared(c, "weather"), BURSTS),
    "hg.model.centred": one(lambda c: hg.model.centred(c, [0.5, 0.5]), CLEAN, NOISY, BURSTS, UNSURE),
    "hg.model.delayed": one(lambda c: hg.model.delayed(c, 1)),
    "hg.model.mean_gain": one(hg.model.mean_gain, CLEAN, NOISY, LOSSY),
    "hg.model.with_direct_link": one(lambda c: hg.model.with_direct_link(c, CLEAN)),
    "hg.model.with_flag": one(hg.model.with_flag, BURSTS, FLAGGED),
    "hg.model.without_memory": one(hg.model.without_memory),
    "hg.random_affine.Mixture": one(lambda c: hg.random_affine.Mixture([c, CLEAN], [0.5, 0.5])),
    "hg.random_affine.Modes": one(lambda c: hg.random_affine.Modes(BURSTS.memory, [c, CLEAN]), CLEAN, NOISY, LOSSY),
    "hg.random_affine.Series": one(lambda c: hg.random_affine.Series([c, CLEAN])),
    "hg.random_affine.Stack": one(lambda c: hg.random_affine.Stack([c, CLEAN])),
    # Filters of filters.
    "hg.adaptive_filter": over(hg.adaptive_filter),
    "hg.filters.late_filter": over(lambda f: hg.filters.late_filter(f, 2)),
    "hg.filters.part_filter": over(lambda f: hg.filters.part_filter(f, 1)),
    "hg.filters.prediction_of": over(hg.filters.prediction_of), "hg.filters.sequential_filter": sequential,
    "hg.simulation.centre_filter": centre, "hg.filters.clock_filter": clocked,
    # Filters of plants.
    **{f"hg.{name}": of_parts(getattr(hg, name)) for name in
       ("cubature_filter", "extended_filter", "mean_gain_filter", "unscented_filter", "robust_filter")},
    **{f"hg.filters.{name}": of_parts(getattr(hg.filters, name), channel=FLAGGED) for name in
       ("imm_filter", "gpb1_filter", "gpb2_filter")},
    "hg.filters.particle_filter": of_parts(lambda *parts: hg.filters.particle_filter(*parts, 9), channel=FLAGGED),
    "hg.filters.gaussian_filter": of_parts(lambda *parts: hg.filters.gaussian_filter(*parts, hg.filters.Cubature())),
    "hg.filters.mixture_filter": of_parts(hg.filters.mixture_filter, PLAIN, COMPASS, CLEAN),
    "hg.kalman_filter": of_parts(lambda *parts: hg.kalman_filter(*parts[:2]), LINEAR, SEEN),
    **{f"hg.filters.{name}": on_line(getattr(hg.filters, name)) for name in
       ("as_current_filter", "fed_back_filter", "memoryless_filter")},
    "hg.linear_filter": on_line(hg.linear_filter),
    **{f"hg.filters.{name}": on_line(getattr(hg.filters, name), channel=FLAGGED) for name in
       ("mode_known_filter", "mode_late_filter", "side_information_filter")},
    **{f"hg.{name}": on_line(lambda *parts, make=make: make(*parts, 4)) for name, make in
       {"polynomial_filter": hg.polynomial_filter, "filters.memory_filter": hg.filters.memory_filter,
        "filters.scheduled_polynomial_filter": hg.filters.scheduled_polynomial_filter}.items()},
    "hg.word_filter": on_line(lambda plant, sensor, channel: hg.word_filter(plant, sensor, encoder=RULER)),
    "hg.filters.likelihood_filter": of_parts(lambda *parts: hg.filters.likelihood_filter(*parts, linear=False)),
    "hg.event_filter": on_line(lambda *parts: hg.event_filter(*parts, hg.SendOnDelta([1.0, 1.0]))),
    # Networks of networks.
    "hg.planning.designed_network": designed, "hg.simulation.freeze": meshed,
    "hg.simulation.node_network": one_node,
}  # fmt: skip
HOLDERS = {  # what holds models as they are given, and what only reads them
    "hg.Network", "hg.Node", "hg.model.RelayNetwork", "hg.h_infinity.HInfinityFilter", "hg.filters.PolynomialFilter",
    "hg.h_infinity.h_infinity_filter", "hg.smoothing.smoother_steps", "hg.simulation.NamedFilter",
    "hg.simulation.find_filter_by_name",
}  # fmt: skip


def test_every_helper_of_the_list_of_names_is_in_the_table():
    found = {name for name, item in public() if takes_and_makes_models(item)}
    known = HELPERS.keys() | HOLDERS
    assert found <= known, f"say what these must carry: {sorted(found - known)}"
    assert known <= {name for name, _ in public()}, "these are gone"


@pytest.mark.parametrize("helper", HELPERS)
def test_it_carries_every_property(helper):
    for made, of, start in HELPERS[helper]():
        if isinstance(of, hg.Network):
            rules = (of_network,)
        elif isinstance(made, hg.filters.AbstractFilter):
            rules = (of_filter,)
        elif isinstance(of, AbstractRandomAffine):
            rules = CHANNELS
        else:
            rules = MODELS
        for rule in rules:
            rule(made, of, start)
