"""Fusion centres that carry joint moments of local errors, and uplinks to them."""
