"""Recorded measurements: screened, filtered by every filter of a network, and smoothed."""
