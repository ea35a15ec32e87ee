"""Filters as source code for devices that have neither Python nor a heap."""
