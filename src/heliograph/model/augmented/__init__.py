"""Augmented models: plants and sensors with further states (biases, clocks, past outputs), and joint sensors."""
