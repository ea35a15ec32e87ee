"""Forecasts from any result or live object: its filters predicted from their last state, which stays as it is."""

from dataclasses import replace
from typing import NamedTuple, TypeAlias

import jax
import numpy as np

from heliograph.factors.factored_gaussian import from_covariance
from heliograph.filters.base import AbstractFilter, FilterAngles
from heliograph.filters.gaussian.gaussian_prediction import open_loop_filter
from heliograph.filters.wrappers.sensor_inputs import FilterOfInputs
from heliograph.filters.wrappers.state_limits import LimitedFilter
from heliograph.filters.wrappers.told_link_law import ToldFilter
from heliograph.forecasting.forecast_result import Forecast, InputsAhead
from heliograph.forecasting.horizons import Horizons, Inputs, RowsAhead, check_inputs_ahead, find_rows_ahead
from heliograph.forecasting.mixture_moments import Moments, make_prediction
from heliograph.forecasting.multistep_prediction import MultistepPredictor, make_multistep_predictor
from heliograph.forecasting.predicted_moments import predict_moments, predict_moments_of_each
from heliograph.forecasting.start_states import Sources, find_common_origin
from heliograph.model.augmented.joint_sensors import joint_sensor
from heliograph.model.estimate import Claim, Estimate, weakest
from heliograph.model.forecast_origin import Origin
from heliograph.model.over_time import first
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node, name_values

Forecasts: TypeAlias = dict[str, dict[str, Forecast]]  # by node and filter


def forecast(source: Sources, horizons: Horizons, inputs: Inputs = None) -> Forecast | Forecasts:
    """Forecast states, what sensors would measure, and what would arrive, from what has arrived so far.

    Each filter predicts from its last state as if nothing more arrived; `source` is not changed. Modes and particles
    are predicted as mixtures. The claim is that of the filter: an exact filter is exact ahead too.

    Args:
        source: what `filter.run`, `hg.run`, a `Stream` or a `Timeline` is: anything with an `origin`. A list of such
            sources of one filter or network is forecast side by side, for the cost of their predictions.
        horizons: a number of steps, for each up to it; or a list of how far ahead: in steps, as spans of time or as
            dates. Where the plant has an input dt, numbers in a list are times, which may lie between steps.
        inputs: what the plant will get, (steps up to the last horizon, inputs), where it has an input dt a row up to
            each horizon and no column of dt; "held" for those of the last step. Needed where the plant has inputs. Of
            a list of sources the same for all, or (sources, steps, inputs).

    Returns:
        A `Forecast` of a single filter; of a network one for each estimate, by node and filter. Of a list of sources
        its arrays have a leading axis of them; `of_source` is that of one.

    Raises:
        ValueError: nothing to forecast from, horizons that are not after the data, inputs that are missing or of
            another shape, more steps than the model covers; a list of sources of other models or other steps.

    Source: the prediction step of the filter, repeated.
    """
    origin = find_common_origin(source)
    forecasts = forecast_from_origin(origin, horizons, inputs)
    return forecasts if isinstance(origin.model, Network) else forecasts[""][""]


def forecast_from_origin(origin: Origin, horizons: Horizons, inputs: Inputs) -> Forecasts:
    """Return the forecast of each estimate of an origin, by node and filter; a single filter has the names "".

    `horizons` and `inputs` are those of `forecast`.
    """
    model = origin.model
    assert isinstance(model, Network | AbstractFilter)  # nothing else makes one
    ahead = find_rows_ahead(origin, model.inputs, horizons, inputs)
    forecasts: Forecasts = {}
    for target in list_targets(origin):
        check_steps_covered(target.predictor.filter, origin.step, ahead.u.shape[-2])
        forecasts.setdefault(target.node, {})[target.filter] = _forecast_target(target, origin, ahead)
    return forecasts


class ForecastTarget(NamedTuple):
    """An estimate that is forecast.

    Args:
        node: name of its node; "" of a single filter.
        filter: name of its filter; "" of a single filter.
        predictor: predicts the filter's state without data, and reads states, outputs and received numbers from it.
        state: the filter's state where the data end.
        received: names of the numbers that the filter receives.
    """

    node: str
    filter: str
    predictor: MultistepPredictor
    state: PyTree
    received: tuple[str, ...]


def find_target(origin: Origin, node: str | None, filter: str | None) -> ForecastTarget:
    """Return the estimate of this node and filter; a None matches any, but only one estimate may match.

    Args:
        origin: where the data end, with the estimates there.
        node: name of the node, or None.
        filter: name of the filter, or None.

    Raises:
        ValueError: no estimate matches, or several do.
    """
    targets = list_targets(origin)
    matching = [target for target in targets if node in (None, target.node) and filter in (None, target.filter)]
    if len(matching) != 1:
        known = ", ".join(f"{target.node}/{target.filter}" for target in targets)
        got = "none" if node is None and filter is None else f"{node}/{filter}"
        raise fail("node and filter", f"one of {known}", got)
    return matching[0]


def list_targets(origin: Origin) -> list[ForecastTarget]:
    """Return what is forecast from an origin: each of its estimates, with the filter and state that are predicted.

    `origin` is where the data end: a network with its filters' states and estimates, or a single filter with its state,
    which has one target, of node and filter "".
    """
    model = origin.model
    if isinstance(model, AbstractFilter):
        predictor = make_multistep_predictor(model)
        outputs = () if predictor.sensor is None else tuple(first(predictor.sensor).outputs)
        received = name_values(outputs, model.received)
        return [ForecastTarget(node="", filter="", predictor=predictor, state=origin.state, received=received)]
    assert isinstance(model, Network)
    targets = []
    for node, filters in origin.estimates.items():
        for name, estimate in filters.items():
            filter, state = _find_filter(model, origin, node, name, estimate)
            predictor = make_multistep_predictor(filter, _find_sensor(model, node), model.plant)
            received = _name_received(model, node)
            targets.append(ForecastTarget(node=node, filter=name, predictor=predictor, state=state, received=received))
    return targets


def _find_filter(
    network: Network, origin: Origin, node: str, name: str, estimate: Estimate
) -> tuple[AbstractFilter, PyTree]:
    """Return the filter that makes an estimate, and its state where the data end.

    A fusion rule has no state of its own to predict. For its estimate this is a filter that only predicts, and its
    state is that of the fused mean and covariance.

    Args:
        network: the model of the origin.
        origin: where the data end. Its `state` holds the states of the nodes' filters, where filters that are computed
            side by side (a stack) have one array, and the states of central filters by name.
        node: node of the estimate.
        name: name of the filter or fusion.
        estimate: the estimate, where the prediction of a fusion begins.
    """
    states_by_stack, states_of_central, *_ = origin.state
    if (node, name) in network.estimate_indices:
        # States of filters of one structure are stacked: those of the first filter at each node of the stack's group,
        # then those of the next filter.
        stack, filter_of_stack, node_of_group = network.estimate_indices[node, name]
        nodes_in_group = len(network.groups[network.stacks[stack].group])
        index = filter_of_stack * nodes_in_group + node_of_group
        return network.nodes[node].filters[name], _take_stacked_state(states_by_stack[stack], index, origin.several)
    if name in states_of_central:
        filter = network.fused[name]
        assert isinstance(filter, AbstractFilter)
        return filter, states_of_central[name]
    return _predict_without_nodes(network, estimate)


def _take_stacked_state(stacked: PyTree, index: int, several: bool) -> PyTree:
    """Return the state number `index` of stacked states.

    They are stacked along the first axis; if there are `several` plants these have the first, and states the second.
    """
    return jax.tree.map(lambda leaf: np.take(leaf, index, axis=int(several)), stacked)


def _predict_without_nodes(network: Network, estimate: Estimate) -> tuple[AbstractFilter, PyTree]:
    """Return a filter that only predicts, and its state: the law with the mean and covariance of a fused estimate.

    A fusion rule combines estimates and has no state of its own, so its forecast is the plant's motion from there. The
    filter has the claim of the estimate, lowered to "nominal" if the prediction is approximate: if the plant is not
    linear or has angles.

    Args:
        network: the network, for its plant.
        estimate: the fused estimate where the data end.
    """
    plant = first(network.plant)
    is_exact = isinstance(plant, LinearPlant) and not plant.circular
    claim = estimate.claim if is_exact or estimate.claim == "none" else weakest([estimate.claim, "nominal"])
    filter = open_loop_filter(network.plant)
    with_claim = replace(filter, claim=claim)
    # `replace` does not copy `kept`, and the filter is frozen.
    object.__setattr__(with_claim, "kept", filter.kept)
    mean = np.asarray(estimate.mean)
    covariance = np.asarray(estimate.covariance)
    if claim == "none":
        covariance = np.zeros_like(covariance)
    make_state = from_covariance if mean.ndim == 1 else _factor_each
    return with_claim, make_state(mean, covariance)


_factor_each = compile_in_float64(jax.vmap(lambda mean, covariance: from_covariance(mean, covariance)))


def _find_sensor(network: Network, node: str) -> AnySensor | None:
    """Return the sensor of a node, or for FUSED (all nodes together) the joint one.

    None if a node has no sensor of its own, or if there is no joint one because a sensor varies over time.
    """
    if node != FUSED:
        single = network.nodes[node]
        return single.sensor if isinstance(single, Node) else None
    sensors = {}
    for name, receiver in network.nodes.items():
        if not isinstance(receiver, Node) or not isinstance(receiver.sensor, AbstractSensor):
            return None
        sensors[name] = receiver.sensor
    return joint_sensor(sensors)


def _name_received(network: Network, node: str) -> tuple[str, ...]:
    """Return the names of the numbers that a node receives; for FUSED, those of all nodes as NODE_NUMBER."""
    if node != FUSED:
        return network.nodes[node].received_names
    return tuple(f"{name}_{number}" for name in network.names for number in network.nodes[name].received_names)


def check_steps_covered(filter: AbstractFilter, step: int | np.ndarray, count: int) -> None:
    """Raise ValueError if models that vary over time do not cover `count` steps from the step number `step` on.

    `step`: number of the first step ahead, or one for each plant. `filter.horizon`: how many steps the models cover,
    None if they do not vary.
    """
    first_ahead = int(np.max(step))  # of several plants that of the one that is furthest on
    if filter.horizon is not None and first_ahead + count > filter.horizon:
        covered = max(filter.horizon - first_ahead, 0)
        raise fail("horizons", f"at most {covered} steps, which the model covers beyond the data", count)


def _forecast_target(target: ForecastTarget, origin: Origin, ahead: RowsAhead) -> Forecast:
    """Return the forecast of one estimate at the horizons: of its states, of the sensor's outputs, and of what arrives.

    The last two are None if the filter does not know its sensor, or does not predict what it receives.

    Args:
        target: the estimate, with its filter's predictor and state.
        origin: where the data end; `several` if there are several plants, whose arrays lead with an axis of plants.
        ahead: inputs of the rows ahead, and the row of each horizon.
    """
    predictor = target.predictor
    filter = predictor.filter
    check_inputs_ahead(filter.inputs, ahead, filter, origin.step)
    predict = predict_moments_of_each if origin.several else predict_moments
    moments_of_rows = predict(predictor, target.state, ahead.u, origin.step)
    axis_of_rows = int(origin.several)
    states, outputs, received = jax.tree.map(lambda leaf: np.take(leaf, ahead.rows, axis=axis_of_rows), moments_of_rows)
    return combine_predictions(
        predictor, (states, outputs, received), target.received, ahead.steps, ahead.time, ahead.inputs
    )


def combine_predictions(
    predictor: MultistepPredictor,
    moments: tuple[Moments | None, ...],
    received_names: tuple[str, ...],
    steps: np.ndarray,
    time: np.ndarray,
    inputs: InputsAhead,
) -> Forecast:
    """Return a forecast with the filter's claims, from moments of the states, the outputs and what arrives.

    A claim says what a covariance is: exact, an upper bound, nominal, or none. Those of the outputs and of what arrives
    may be weaker than that of the states.

    Args:
        predictor: the filter, its sensor and the limits of the states.
        moments: means and covariances at each horizon of the states, the sensor's outputs, and the numbers that arrive
            through the channel; None where they are not predicted.
        received_names: names of the numbers that arrive.
        steps: how far ahead each horizon is.
        time: time of each horizon.
        inputs: whether inputs were "given" or "held"; "none" of a plant without.
    """
    states, outputs, received = moments
    assert states is not None  # a filter always predicts its states
    filter, sensor = predictor.filter, first(predictor.sensor)
    angles = filter.angles_used() or FilterAngles((), ())
    # Each prediction gets its own claim, and its angles between -pi and pi.
    predicted_outputs = predicted_received = None
    if outputs is not None:
        output_claim = _find_output_claim(filter, predictor)
        predicted_outputs = make_prediction(outputs, tuple(sensor.outputs), output_claim, sensor.angles)
    if received is not None:
        received_claim = _find_received_claim(filter)
        predicted_received = make_prediction(received, received_names, received_claim, angles.received)
    return Forecast(
        steps=steps,
        time=time,
        states=make_prediction(states, filter.states, filter.claim, angles.states, predictor.limits),
        outputs=predicted_outputs,
        received=predicted_received,
        inputs=inputs,
    )


def _find_output_claim(filter: AbstractFilter, predictor: MultistepPredictor) -> Claim:
    """Return the claim of the predicted outputs: what their covariance is said to be.

    It is that of the filter, "exact", "upper", "nominal" or "none". Moments through a nonlinear sensor, and those of
    angles, are approximate: the claim is at most "nominal" then.

    Args:
        filter: the filter.
        predictor: predicts its states and outputs; has the sensor.
    """
    sensor = first(predictor.sensor)
    is_exact = isinstance(sensor, LinearSensor) and not sensor.circular
    return filter.claim if is_exact or filter.claim == "none" else weakest([filter.claim, "nominal"])


def _find_received_claim(filter: AbstractFilter) -> Claim:
    """Return the claim of what is predicted to arrive: the filter's, or "nominal" if example numbers stand for unknown.

    A `ToldFilter` receives numbers with each message that determine the link's law, such as a noise variance. They are
    not known ahead. Unless their own law is known, an example of them is used, with which the covariance is nominal.
    """
    base = filter
    while isinstance(base, LimitedFilter | FilterOfInputs):
        base = base.base
    if isinstance(base, ToldFilter) and not base.knows_law_of_numbers and filter.claim != "none":
        return weakest([filter.claim, "nominal"])
    return filter.claim
