"""Sizes that decide which engine computes a program: each says what was measured.

What native code takes at all is decided in `straightline`, operation by operation.
"""

# Operations, those that fold among them: of 120,000 that are left LLVM takes half as long as XLA; a longer program than
# this is left to XLA.
LONG = 400_000
# Operations of what runs once: native code of 11,000 takes as long to make as a program of XLA, one of a thousand a
# third.
SHORT = 8_000
# Numbers of all covariances that a mesh sends in a step: of 6,800 (40 nodes of four states) XLA's program is made in
# 10 s of a processor, native code was not in a minute.
MESH_NUMBERS = 3_000
# Rows of a joint covariance that a mesh follows: of 48 (12 nodes) the first call takes 11.5 s natively and 9.2 s by
# XLA, later ones 21 and 20 us a node, run and step.
MESH_ROWS = 40
# Runs of a simulation side by side: wide enough for vector units, small enough for the cache.
BLOCK = 32
