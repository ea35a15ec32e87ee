"""Filters of links with modes: observed, observed late, or hidden."""
