"""Engines that simulate many runs: native code, or XLA in lanes."""
