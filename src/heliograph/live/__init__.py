"""Filters on data as they arrive: in order, late, twice."""
