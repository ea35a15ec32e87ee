"""Cubature Kalman fusion filtering under amplify-and-forward relays, reproduced and repaired; see README.md."""
