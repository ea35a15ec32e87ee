"""Packets that a recorded radio network delivered late, out of order and twice, and what a filter makes of them."""

from heliograph.examples.late_data.run import example as example
