import pytest

from heliograph.campaign.run import run_campaign
from tests.campaign.example import CHUNKS, contents, write


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """The results of a campaign that ran undisturbed in one process."""
    folder = tmp_path_factory.mktemp("undisturbed")
    result = run_campaign(write(folder), folder / "out", workers=0)
    assert (result.already, result.computed, result.failures) == (0, CHUNKS, [])
    return folder / "out"


@pytest.fixture(scope="session")
def expected(finished):
    return contents(finished)
