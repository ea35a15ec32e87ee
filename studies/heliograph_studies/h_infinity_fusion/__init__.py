"""Quantized H-infinity fusion over amplify-and-forward relays, reproduced and judged; see README.md."""

from heliograph_studies.h_infinity_fusion.run import reproduce
from heliograph_studies.old import Old

publication = Old(reproduce)
