"""Gaussians by their mean and the factors L diag(d) L' of their covariance."""
