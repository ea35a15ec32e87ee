"""Estimates in tables: of a recording, and forecasts below them."""
