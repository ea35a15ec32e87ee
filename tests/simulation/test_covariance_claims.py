"""Claims in a network: a filter's own where it believes the world in which it stands, else nominal at most."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph import serving

PLANT = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.1)
LINK = hg.hop(1.0, 0.1)
STRONG = ("exact", "upper")


def network_of(link, item, plant=PLANT, sensor=SENSOR, **options):
    return hg.Network(plant, {"a": hg.Node(sensor, link, {"f": item}, **options)})


def claim_at(link, item, **options):
    return network_of(link, item, **options).claims()["a"]["f"]


def gilbert(good=1.0, bad=0.2):
    return hg.gilbert_elliott(hg.hop(good, 0.1), hg.hop(bad, 0.1), 0.1, 0.3)


def late(delays=(0, 1), shares=(0.5, 0.5)):
    return hg.model.delayed(LINK, hg.Discrete(list(delays), list(shares)))


def linear(link):
    return hg.linear_filter(PLANT, SENSOR, link)


KALMAN = hg.kalman_filter(PLANT, SENSOR)
OTHER = hg.LinearPlant([[0.99]], 0.1, [0.0], 1.0)
CHANCE = hg.StochasticTrigger(1.0)
ELSEWHERE = {
    "a dropout that it does not know": (hg.dropout(LINK, 0.7), linear(LINK), {}, "channel"),
    "fading": (hg.hop(hg.Rayleigh(1.0), 0.1), KALMAN, {}, "channel"),
    "another plant": (hg.perfect(), KALMAN, {"plant": OTHER}, "plant"),
    "another start": (hg.perfect(), KALMAN, {"plant": hg.LinearPlant([[0.9]], 0.1, [1.0], 1.0)}, "plant"),
    "another sensor": (hg.perfect(), KALMAN, {"sensor": hg.LinearSensor([[1.0]], 0.2)}, "sensor"),
    "memory": (gilbert(), linear(hg.model.without_memory(gilbert())), {}, "channel"),
    "no delay": (late(), linear(LINK), {}, "channel"),
    "another delay": (late(), linear(late(shares=(0.9, 0.1))), {}, "channel"),
    "a dropout instead of an erasure": (hg.erasure(LINK, 0.7), linear(hg.dropout(LINK, 0.7)), {}, "channel"),
    "losses that come with noise": (
        hg.gilbert_elliott(hg.erasure(LINK, 0.9), hg.erasure(hg.hop(1.0, 0.5), 0.5), 0.1, 0.3), linear(LINK), {},
        "channel",
    ),
    "a sender that decides": (hg.perfect(), KALMAN, {"trigger": hg.SendOnDelta(0.5)}, "trigger"),
    "another rule of the sender": (
        hg.perfect(), hg.event_filter(PLANT, SENSOR, hg.perfect(), CHANCE), {"trigger": hg.StochasticTrigger(2.0)},
        "trigger",
    ),
    "no sender": (hg.perfect(), hg.event_filter(PLANT, SENSOR, hg.perfect(), CHANCE), {}, "trigger"),
    "an uncertain law": (hg.dropout(LINK, 0.7, 0.1), linear(hg.dropout(LINK, 0.7)), {}, "channel"),
    "another law of powers": (
        hg.hop(1.0, hg.random_affine.FiniteSupport([[-0.1], [0.9]], [0.9, 0.1])),
        hg.polynomial_filter(PLANT, SENSOR, hg.hop(1.0, 0.09), 5), {}, "channel",
    ),
    "a bound of the noise": (
        hg.perfect(), KALMAN,
        {"sensor": hg.LinearSensor([[1.0]], hg.Contaminated.at_most(0.05, 0.1, 0.55))}, "sensor",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", ELSEWHERE)
def test_a_filter_made_for_another_world_claims_nothing_and_the_part_is_named(case):
    link, item, options, part = ELSEWHERE[case]
    network = network_of(link, item, **options)
    assert item.claim in STRONG
    assert network.claims() == {"a": {"f": "nominal"}}
    assert [belief.words for belief in network.beliefs()] == [f"filter 'f' believes another {part} than node 'a'"]
    assert f"f (nominal, believes another {part})" in repr(network)


def test_a_node_that_refuses_values_by_their_size_claims_nothing_and_a_code_costs_nothing():
    blind = hg.filters.open_loop_filter(PLANT)
    nodes = {
        "a": hg.Node(SENSOR, hg.perfect(), {"f": KALMAN, "open": blind}, limits=(-2, None)),
        "b": hg.Node(SENSOR, hg.perfect(), {"f": KALMAN}, limits=(None, None), invalid=-999),
    }
    joint = hg.kalman_filter(PLANT, hg.model.joint_sensor({"a": SENSOR, "b": SENSOR}))
    network = hg.Network(PLANT, nodes, fused={"all": joint, "cross": hg.Fusion("f", hg.fusion.MatrixWeights())})
    fused = {"all": "nominal", "cross": "nominal"}
    assert network.claims() == {"a": {"f": "nominal", "open": "exact"}, "b": {"f": "exact"}, "fused": fused}
    why = "believes another range of values"
    assert [belief.words for belief in network.beliefs()] == [
        f"filter 'f' {why} than node 'a', where some are refused",
        f"filter 'all' {why} than all nodes together, where some are refused",
    ]
    assert f"f (nominal, {why})" in repr(network) and f"(nominal, {why})" in repr(network).split("fused all")[1]
    said = [doubt.words for doubt in hg.simulation.doubts_before_data(network)]
    assert f"another world: {network.beliefs()[0].words}, so that its claim is nominal" in said
    record = hg.run(network, {"a": [[0.1], [1.0]], "b": [[0.2], [0.3]]})
    assert record.estimates["a"]["f"].claim == "nominal" and record.estimates["b"]["f"].claim == "exact"


def test_behind_a_link_whose_losses_tell_of_its_gain_a_code_is_taken_for_a_loss():
    """With .3 of the values refused the errors of the linear filter, exact without, are 1.6 of what it claims."""

    def claim_behind(good, bad, **refusing):
        lossy = [hg.erasure(link, arrival) for link, arrival in ((good, 0.95), (bad, 0.3))]
        link = hg.gilbert_elliott(*lossy, 0.05, 0.05)
        node = hg.Node(SENSOR, link, {"f": hg.linear_filter(PLANT, SENSOR, link)}, **refusing)
        return hg.Network(PLANT, {"a": node}).claims()["a"]["f"]

    other_gain, other_noise = hg.hop(0.4, 0.05), hg.hop(1.0, 0.5)
    assert claim_behind(LINK, other_gain) == claim_behind(hg.hop(1.0, 0.1), other_noise) == "exact"
    assert claim_behind(hg.perfect(), hg.perfect(), invalid=-999) == "exact"  # bursts of losses, of one gain
    assert claim_behind(LINK, other_gain, invalid=-999) == claim_behind(LINK, other_gain, limits=(-9, 9)) == "nominal"
    assert claim_behind(hg.hop(1.0, 0.1), other_noise, invalid=-999) == "nominal"


def test_a_code_of_a_sender_by_chance_is_taken_for_silence():
    node = hg.Node(
        SENSOR, hg.perfect(), {"f": hg.event_filter(PLANT, SENSOR, hg.perfect(), CHANCE)}, trigger=CHANCE, invalid=-999
    )
    assert node.filters["f"].claim == "exact" and hg.Network(PLANT, {"a": node}).claims() == {"a": {"f": "nominal"}}


def rebuilt():
    """The same world, written again: other objects, equal numbers."""
    return hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)


def test_a_world_that_is_built_again_is_the_same_one():
    plant, sensor = rebuilt()
    for make in (lambda: LINK, gilbert, late, lambda: hg.dropout(LINK, 0.7, 0.1), lambda: hg.erasure(gilbert(), 0.8)):
        item = hg.linear_filter(*rebuilt(), make())
        assert claim_at(make(), item, plant=plant, sensor=sensor) == item.claim
    chance = hg.event_filter(*rebuilt(), hg.perfect(), hg.StochasticTrigger(1.0))
    assert claim_at(hg.perfect(), chance, plant=plant, sensor=sensor, trigger=hg.StochasticTrigger(1.0)) == "exact"


def test_what_does_not_matter_to_a_claim_may_differ():
    """Losses that the receiver knows of, a schedule, and the shape of a law whose first two moments are believed."""
    bursts = hg.gilbert_elliott(hg.erasure(hg.perfect(), 0.9), hg.erasure(hg.perfect(), 0.2), 0.1, 0.3)
    atoms = hg.random_affine.FiniteSupport([[-(0.1**0.5)], [0.1**0.5]], [0.5, 0.5])
    assert claim_at(bursts, KALMAN) == "exact"
    assert claim_at(hg.perfect(), KALMAN, trigger=hg.Periodic(3)) == "exact"
    assert claim_at(hg.perfect(), KALMAN, sensor=hg.LinearSensor([[1.0]], atoms)) == "exact"
    rician = hg.random_affine.Rician(0.9, 0.2)
    alike = hg.Discrete([rician.moment(1) - 0.1, rician.moment(1) + 0.1], [0.5, 0.5])
    spread = rician.moment(2) - rician.moment(1) ** 2
    two = hg.Discrete([rician.moment(1) - spread**0.5, rician.moment(1) + spread**0.5], [0.5, 0.5])
    assert claim_at(hg.hop(rician, 0.1), linear(hg.hop(two, 0.1))) == "exact"
    assert claim_at(hg.hop(rician, 0.1), linear(hg.hop(alike, 0.1))) == "nominal"


def time_step(scale):
    table = np.asarray([scale, 1.0])
    return hg.LinearPlant(
        lambda u: jnp.array([[1.0, u[0]], [0.0, 1.0]]), lambda u: u[0] * jnp.diag(table), [0, 0], np.eye(2),
        inputs=["dt"],
    )  # fmt: skip


def test_functions_of_a_plant_are_compared_as_programs_with_their_constants():
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.1)
    item = hg.kalman_filter(time_step(0.1), sensor)
    assert claim_at(hg.perfect(), item, plant=time_step(0.1), sensor=sensor) == "exact"
    assert claim_at(hg.perfect(), item, plant=time_step(0.2), sensor=sensor) == "nominal"


def test_links_that_are_shared_at_nodes_and_not_in_the_filter_of_the_centre():
    """Two bad links at the same time: 1.869 claimed by links apart, 2.650 true."""
    plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0)
    streets = [hg.shared(gilbert(), "street") for _ in range(2)]
    sensor = hg.LinearSensor([[1.0], [1.0]], 0.1 * np.eye(2))
    central = {
        "apart": hg.linear_filter(plant, sensor, hg.parallel([gilbert(), gilbert()])),
        "together": hg.linear_filter(plant, sensor, hg.parallel(streets)),
    }
    nodes = {n: hg.Node(SENSOR, link, {}) for n, link in zip("ab", streets, strict=True)}
    network = hg.Network(plant, nodes, central)
    assert network.claims()["fused"] == {"apart": "nominal", "together": "exact"}
    assert [b.words for b in network.beliefs()] == ["filter 'apart' believes another channel than all nodes together"]


def test_a_filter_alone_keeps_its_claim():
    network = network_of(hg.dropout(LINK, 0.7), item := linear(LINK))
    assert network.claims() == {"a": {"f": "nominal"}}
    assert item.claim == item.run(np.zeros((2, 1))).claim == "exact"
    assert hg.Stream(item).push([0.0]).claim == "exact"


@pytest.mark.slow
def test_the_word_goes_wherever_the_claim_goes(tmp_path):
    """Filtered, smoothed, lagged, fused; records, statistics, tables; streams, timelines, C; single precision."""
    nodes = {n: hg.Node(SENSOR, hg.perfect(), {"f": KALMAN}, trigger=hg.SendOnDelta(0.5)) for n in "ab"}
    network = hg.Network(PLANT, nodes, {"all": hg.Fusion("f", hg.CovarianceIntersection())})
    assert {claim for by_name in network.claims().values() for claim in by_name.values()} == {"nominal"}
    settings = {"horizon": 4, "runs": 2, "key": 0}
    for smooth in (None, hg.smoothing.FixedInterval(), hg.smoothing.FixedLag(1), hg.smoothing.FixedPoint(1)):
        record = hg.monte_carlo(network, smooth=smooth, **settings)
        kept = hg.monte_carlo(network, smooth=smooth, keep=hg.Statistics(), **settings)
        for place in ("a", "b", "fused"):
            for name, estimate in record.estimates[place].items():
                assert estimate.claim == kept[place][name].claim == "nominal"
    data = hg.run(network, {n: np.arange(3.0)[:, None] for n in "ab"}, smooth=hg.smoothing.FixedInterval())
    assert {e.claim for of in data.estimates.values() for e in of.values()} == {"nominal"}
    assert hg.Stream(network.nodes["a"].filters["f"]).push([0.0]).claim == "nominal"
    hg.export_c(network.nodes["a"].filters["f"], tmp_path / "step.c")
    assert "Claim: nominal" in (tmp_path / "step.h").read_text()


@pytest.mark.slow
def test_the_word_goes_into_tables_timelines_single_precision_and_what_a_service_tells():
    """A Kalman filter behind losses by silence that it takes for none."""
    network = network_of(hg.dropout(LINK, 0.7), linear(LINK))
    single = hg.monte_carlo(network, 4, 2, 0, precision="float32")
    assert single.estimates["a"]["f"].claim == "nominal"
    timeline = hg.Timeline(network, 5.0)
    timeline.push("a", 0, 0.0, [0.5], 0.0)
    assert timeline.estimates()["a"]["f"].claim == "nominal"
    kept = hg.monte_carlo(network, 4, 2, 0, keep=hg.Statistics())
    assert kept.to_pandas().loc["a", "f"]["claim"] == "nominal"
    fleet = serving.Fleet(serving.NetworkProgram(network), serving.Options(window=5.0, step=1.0))
    service = serving.Service(fleet, serving.InMemoryStore())
    body = {"plant": "p", "node": "a", "sequence": 0, "time": 0.0, "values": [0.5]}
    told = [json.loads(output.body) for output in service.take([json.dumps(body).encode()])]
    assert {message["estimates"]["a"]["f"]["claim"] for message in told if "estimates" in message} == {"nominal"}


class World:
    """Plant, sensor, link and sender of a node, built anew from numbers whenever asked for."""

    def __init__(self, numbers):
        self.numbers = dict(numbers)

    def changed(self, part, generator):
        """Another world that differs in one number alone."""
        value = self.numbers[part]
        other = (
            generator.integers(1, 3)
            if isinstance(value, int)
            else value * (0.7 if part == "radius" else generator.choice([0.7, 1.4]))
        )
        return World(self.numbers | {part: other + value * isinstance(value, int)})

    @property
    def plant(self):
        n = self.numbers
        return hg.LinearPlant(
            [[n["drift"], 0.1], [0.0, 0.8]], n["noise"] * np.eye(2), [n["start"], 0.0], n["spread"] * np.eye(2)
        )

    @property
    def sensor(self):
        return hg.LinearSensor([[self.numbers["gain"], 0.5]], self.numbers["error"])

    @property
    def link(self):
        n = self.numbers
        hop = hg.hop(hg.random_affine.Rician(n["sight"], n["scatter"]), n["hop_noise"])
        second = hg.hop(n["relay"], 0.2)
        kinds = {
            "hop": lambda: hop,
            "relay": lambda: hg.amplify_and_forward([hop, second]),
            "dropout": lambda: hg.dropout(second, n["arrival"]),
            "radius": lambda: hg.dropout(second, n["arrival"], n["radius"]),
            "memory": lambda: hg.gilbert_elliott(hop, second, n["fail"], n["recover"]),
            "late": lambda: hg.model.delayed(hop, hg.Discrete([0, 1], [n["arrival"], 1 - n["arrival"]])),
            "constant": lambda: hg.model.delayed(hop, n["delay"]),
        }
        return kinds[n["kind"]]()


OF_LINK = {
    "hop": ["sight", "scatter", "hop_noise"], "relay": ["sight", "scatter", "hop_noise", "relay"],
    "dropout": ["arrival", "relay"], "radius": ["arrival", "relay", "radius"],
    "memory": ["sight", "hop_noise", "fail", "recover", "relay"], "late": ["sight", "arrival", "hop_noise"],
    "constant": ["sight", "delay"],
}  # fmt: skip
OF_NODE = ["drift", "noise", "start", "spread", "gain", "error"]
PART = dict.fromkeys(OF_NODE[:4], "plant") | dict.fromkeys(OF_NODE[4:], "sensor")


def drawn(generator):
    return World({
        **{name: float(generator.uniform(0.2, 0.7)) for name in
           ("drift", "noise", "start", "spread", "gain", "error", "sight", "scatter", "hop_noise", "relay", "arrival")},
        "fail": float(generator.uniform(0.05, 0.3)), "recover": float(generator.uniform(0.2, 0.5)), "radius": 0.05,
        "delay": int(generator.integers(1, 3)), "kind": str(generator.choice(list(OF_LINK))),
    })  # fmt: skip


MAKERS = {  # filters that claim more than nominal, and the links for which they do
    "linear": (hg.linear_filter, list(OF_LINK)),
    "polynomial": (lambda *parts: hg.polynomial_filter(*parts, 2), ["hop", "relay", "dropout", "memory"]),
    "modes": (hg.filters.mode_known_filter, ["hop", "relay", "dropout"]),
}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_of_random_worlds_only_the_filters_own_keeps_its_claim(seed):
    """25 worlds each, with filters for that world, built again, and those for a world that differs in one number."""
    generator = np.random.default_rng(seed)
    for _ in range(25):
        world = drawn(generator)
        kind = world.numbers["kind"]
        part = str(generator.choice(OF_NODE + OF_LINK[kind]))
        other = world.changed(part, generator)
        for make in (make for make, links in MAKERS.values() if kind in links):
            right, wrong = (make(w.plant, w.sensor, w.link) for w in (world, other))
            node = hg.Node(world.sensor, world.link, {"right": right, "wrong": wrong})
            network = hg.Network(world.plant, {"a": node})
            assert right.claim in STRONG and wrong.claim in STRONG
            assert network.claims()["a"] == {"right": right.claim, "wrong": "nominal"}, (world.numbers, part)
            assert [(b.filter, b.parts) for b in network.beliefs()] == [("wrong", (PART.get(part, "channel"),))]


def test_a_filter_that_does_not_say_what_it_believes_claims_nothing():
    system = hg.linear.lifted_system(PLANT, SENSOR, LINK, 1, 4)
    said = hg.filters.LinearSystemFilter(system)
    bare = hg.linear.LinearSystem(system.steps, system.mean, system.covariance, system.projection)
    network = network_of(LINK, said)
    assert network.claims() == {"a": {"f": "exact"}} and network.beliefs() == ()
    network = network_of(LINK, hg.filters.LinearSystemFilter(bare))
    assert network.claims() == {"a": {"f": "nominal"}}
    assert [b.words for b in network.beliefs()] == ["filter 'f' believes something that it does not say at node 'a'"]


def relayed(gain=1.0, own=0.1):
    plant, sensor = rebuilt()
    slots = [{"relay": {"sensor": hg.hop(gain, own)}, "receiver": {"relay": hg.hop(0.5, 0.1)}}]
    return hg.model.RelayNetwork(plant, sensor, ["relay"], slots)


def of_relays(world, believed, of_receiver):
    schedules = hg.relays.relay_schedules(believed, hg.relays.local_error_design(believed, 4))
    local = hg.filters.ScheduledFilter(schedules.pop("receiver"))
    gains = hg.relays.local_error_design(of_receiver, 4).gains
    best = hg.filters.LinearSystemFilter(hg.relays.receiver_system(of_receiver, gains))
    return hg.Network.of_relays(world, schedules, {"local": local, "best": best})


@pytest.mark.slow
def test_relays_and_their_receiver_believe_hops_and_the_gains_that_run():
    network = of_relays(relayed(), relayed(), relayed())
    assert network.claims() == {
        "relay": {"local": "exact"}, "receiver": {"local": "exact", "best": "exact"},
    }  # fmt: skip
    alone = hg.run(network, {"receiver": np.zeros((4, 1))})  # a recording without what the relay received
    assert {estimate.claim for estimate in alone.estimates["receiver"].values()} == {"exact"}
    assert of_relays(relayed(), relayed(2.0), relayed(2.0)).claims() == {
        "relay": {"local": "nominal"}, "receiver": {"local": "nominal", "best": "nominal"},
    }  # fmt: skip
    others = of_relays(relayed(), relayed(), relayed(own=0.4)).claims()
    assert others["receiver"] == {"local": "exact", "best": "nominal"}
