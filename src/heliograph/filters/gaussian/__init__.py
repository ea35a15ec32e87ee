"""Filters that carry a mean and a covariance: transforms of moments, and updates that know the channel."""
