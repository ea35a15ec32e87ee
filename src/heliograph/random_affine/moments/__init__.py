"""Joint moments of random affine maps and of noises, their atoms, and what becomes of a signal that passes."""
