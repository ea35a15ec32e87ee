"""Recursive filtering with filter-and-forward successive relays, reproduced and repaired; see README.md."""
