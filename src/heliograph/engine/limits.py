"""Sizes that decide which engine computes a program: each says what was measured.

What native code takes at all is decided in `straightline`, operation by operation.
"""

LONG = 400_000  # operations, those that fold among them: beyond it LLVM takes longer than XLA compiles
SHORT = 8_000  # operations of what runs once: native code of 11,000 takes as long to make as a program of XLA
MESH_NUMBERS = 3_000  # of all covariances that are sent in a step of a mesh: of more, native code takes longer to make
MESH_ROWS = 40  # of a joint covariance that a mesh follows: of more, XLA's matrix products are as fast, made sooner
