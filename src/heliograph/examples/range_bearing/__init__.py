"""A station that measures range and bearing: across the cut at pi, and close by behind a relay that fades."""

from heliograph.examples.range_bearing.run import example as example
