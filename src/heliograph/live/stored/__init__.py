"""Stored states: a plant as bytes, what a store is of, and states of other networks and versions carried over."""
