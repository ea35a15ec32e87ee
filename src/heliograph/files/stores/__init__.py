"""Stores of time series: tables read from InfluxDB and PostgreSQL, and estimates written there."""
