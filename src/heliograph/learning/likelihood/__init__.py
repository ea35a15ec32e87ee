"""Likelihoods of recordings: what a fit maximises, and how."""
