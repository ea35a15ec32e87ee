"""One campaign that ran undisturbed, for all modules of this folder."""

import pytest


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """The results of a campaign that ran undisturbed in one process."""
    from heliograph.campaign.run import run_campaign  # not before tests/conftest.py has set how JAX compiles
    from tests.campaign.example import CHUNKS, write

    folder = tmp_path_factory.mktemp("undisturbed")
    result = run_campaign(write(folder), folder / "out", workers=0)
    assert (result.already, result.computed, result.failures) == (0, CHUNKS, [])
    return folder / "out"


@pytest.fixture(scope="session")
def expected(finished):
    from tests.campaign.example import contents

    return contents(finished)
