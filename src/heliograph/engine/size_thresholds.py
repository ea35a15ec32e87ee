"""Sizes that decide which engine computes a program: each says what was measured.

What native code takes at all is decided in `straightline`, operation by operation.
"""

# Operations of what runs once: native code of 11,000 takes as long to make as a program of XLA, one of a thousand a
# third.
SHORT = 8_000
# Numbers of covariances that a mesh computes in a step, those that are sent, or twice those of a joint one: natively
# up to 430 operations for each (10 nodes of 2 states: 130), so that of more most are refused, but after seconds only.
MESH = 3_200
# Runs of a simulation side by side: wide enough for vector units, small enough for the cache.
BLOCK = 32
