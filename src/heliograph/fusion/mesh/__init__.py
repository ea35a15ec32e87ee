"""Estimation without a centre: who receives whom, what a node does with what arrived, and what its error is then."""
