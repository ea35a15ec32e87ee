"""Kalman filtering with intermittent observations and its successors, reproduced and judged; see README.md."""

from heliograph_studies.intermittent_observations.run import reproduce
from heliograph_studies.old import Old

publication = Old(reproduce)
