"""Filters made of another filter: delayed, relayed, predicted, fed back, with clocks."""
