"""What the beginning of a timeline costs, counted."""

import logging

import jax
import pytest

import heliograph as hg
from heliograph.live.network_step_program import NetworkProgram
from heliograph.simulation.runs import StackedFilters
from tests.live import worlds

SEEN = 1  # program, of the test: the filters begin by native code; there were 136


@pytest.mark.slow
def test_a_timeline_begins_with_no_program_of_xla(caplog):
    """What is copied to a device outside of a program must not be a program for each of its shapes."""
    network = worlds.remembering()
    jax.clear_caches()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        hg.Timeline(network, 4.0, capacity=30)
        jax.jit(lambda x: x + 1)(0.5)  # which is seen
    compiled = [line for line in map(logging.LogRecord.getMessage, caplog.records) if "XLA compilation of" in line]
    assert len(compiled) == SEEN, compiled


def test_a_step_is_traced_once_for_its_outputs_its_code_and_its_text(monkeypatch):
    """With all measurements, and without those that are implausible: tracing is most of what beginning costs."""
    calls, step = [], StackedFilters.step  # of the one group of filters
    monkeypatch.setattr(StackedFilters, "step", lambda filters, *data: calls.append(data) or step(filters, *data))
    plant = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5, states=["traced here alone"])
    item = hg.kalman_filter(plant, worlds.SENSOR)
    made = NetworkProgram(hg.Network(plant, {"a": hg.Node(worlds.SENSOR, hg.perfect(), {"f": item})})).step_rows
    assert made.program and len(calls) == 1
