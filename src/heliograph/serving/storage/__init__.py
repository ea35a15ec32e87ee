"""Stores of what a service knows."""
