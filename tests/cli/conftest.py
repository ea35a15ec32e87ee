"""A folder with a network and its data."""

import pytest

from tests.cli.example import DATA, NETWORK


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text(NETWORK)
    (tmp_path / "data.csv").write_text(DATA)
    return tmp_path
