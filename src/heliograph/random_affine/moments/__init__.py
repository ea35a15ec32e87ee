"""Joint moments of random affine maps and of noises."""
