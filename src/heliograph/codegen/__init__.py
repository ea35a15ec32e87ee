"""Steps as straight-line code: a traced function of one run as scalar operations, compiled for many runs at once."""
