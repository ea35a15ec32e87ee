"""What the beginning of a timeline costs, counted."""

import logging

import jax

import heliograph as hg
from tests.live import worlds

FEW = 4  # programs: the filters begin by one; there were 136


def test_a_timeline_begins_with_few_programs(caplog):
    """What is copied to a device outside of a program must not be a program for each of its shapes."""
    network = worlds.remembering()
    jax.clear_caches()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        hg.Timeline(network, 4.0, capacity=30)
    compiled = [line for line in map(logging.LogRecord.getMessage, caplog.records) if "XLA compilation of" in line]
    assert 0 < len(compiled) <= FEW, compiled
