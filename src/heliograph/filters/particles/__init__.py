"""Particle filters of the state, and what particle filters share: resampling, and keys made of data."""
