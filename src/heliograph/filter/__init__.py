"""Filters: `base` says what one is, `gaussian` and `linear` build them, `update` holds the bounds they minimise."""
