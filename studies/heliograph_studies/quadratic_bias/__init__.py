"""Quadratic filtering with dynamical bias under amplify-and-forward relays, reproduced and repaired; see README.md."""

from heliograph_studies.old import Old
from heliograph_studies.quadratic_bias.run import reproduce

publication = Old(reproduce)
