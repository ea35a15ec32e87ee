"""Links learned from recordings: whether intervals cover the truth behind random gains, method by method."""

from heliograph.examples.learning.run import example as example
