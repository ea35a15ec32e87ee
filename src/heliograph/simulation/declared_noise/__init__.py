"""Judgement of covariances that messages declare, from a recording: sizes and memory of innovations, and a refit."""
