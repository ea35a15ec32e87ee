"""Recursive filtering with filter-and-forward successive relays, reproduced and repaired; see README.md."""

from heliograph_studies.old import Old
from heliograph_studies.successive_relays.run import reproduce

publication = Old(reproduce)
