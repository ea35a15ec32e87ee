"""Data that come late, told or not, and clocks that are wrong: what filters claim, and what is true."""

from heliograph.examples.delays.run import example as example
