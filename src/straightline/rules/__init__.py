"""Rules: how each operation of JAX becomes scalar operations."""
