"""A network's file, with whatever else it names."""

import runpy

import heliograph as hg


def load_module(path):
    """The network of a file, and all names of the file, such as `sources`."""
    return hg.files.load_network(path), runpy.run_path(path)
