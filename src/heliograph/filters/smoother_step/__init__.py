"""Smoother steps: data of a filter step that a backward pass needs."""
