"""Quantized H-infinity fusion over amplify-and-forward relays, reproduced and judged; see README.md."""
