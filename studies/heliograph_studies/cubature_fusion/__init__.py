"""Cubature Kalman fusion filtering under amplify-and-forward relays, reproduced and repaired; see README.md."""

from heliograph_studies.cubature_fusion.run import reproduce
from heliograph_studies.old import Old

publication = Old(reproduce)
