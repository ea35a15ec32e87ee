"""Arithmetic and checks that know nothing of estimation."""
