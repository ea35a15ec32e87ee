"""Quadratic filtering with dynamical bias under amplify-and-forward relays, reproduced and repaired; see README.md."""
