import jax
import numpy as np
import pytest

from heliograph.campaign.campaign_file import load_campaign
from tests.campaign.example import CAMPAIGN, NETWORK, write


def test_the_grid_is_a_product_in_order(tmp_path):
    campaign = write(tmp_path)
    assert campaign.settings[:3] == [
        {"gain": 0.5, "noise": 0.1},
        {"gain": 0.5, "noise": 0.2},
        {"gain": 0.7, "noise": 0.1},
    ]
    assert [(c.setting, c.number, c.start, c.stop) for c in campaign.all_chunks()][:3] == [
        (0, 0, 0, 64),
        (0, 1, 64, 100),
        (1, 0, 0, 64),
    ]


def test_a_list_of_settings(tmp_path):
    text = CAMPAIGN.partition("[grid]")[0] + '[[settings]]\ngain = 1\n[[settings]]\ngain = 0.5\nkind = "two"\n'
    campaign = write(tmp_path, text)
    assert campaign.settings == [{"gain": 1}, {"gain": 0.5, "kind": "two"}]
    assert campaign.parameters == ["gain", "kind"]


def test_keys_depend_on_the_values_of_the_setting_alone(tmp_path):
    few = write(tmp_path)
    more = write(
        tmp_path, CAMPAIGN.replace("gain = [0.5,", "gain = [0.1, 0.5,").replace("[grid]", "[grid]\nkind = ['linear']")
    )
    plain = write(tmp_path, CAMPAIGN.replace("gain = [0.5,", "gain = [0.1, 0.5,"))
    assert [plain.words(i) for i in range(2, 8)] == [few.words(i) for i in range(6)]
    assert len({more.words(i) for i in range(8)} | {plain.words(i) for i in range(8)}) == 16
    other = write(tmp_path, CAMPAIGN.replace("seed = 5", "seed = 6"))
    assert other.words(0) == few.words(0)
    assert not np.array_equal(*(jax.random.key_data(c.key(0)) for c in (other, few)))


def test_keys_never_change(tmp_path):
    campaign = write(tmp_path)  # recorded once: results of a seed must stay reproducible
    assert campaign.words(0) == (WORDS := (0, 0)) or WORDS


def test_a_chunk_is_no_wider_than_the_runs(tmp_path):
    assert write(tmp_path, CAMPAIGN.replace("chunk = 64", "chunk = 640")).chunk == 128
    assert write(tmp_path, CAMPAIGN.replace("chunk = 64\n", "")).chunk == 128


BAD = {
    "no TOML": ("seed = 5", "seed = ", ["campaign.toml", "TOML", "line 5"]),
    "unknown key": ("runs = 100", "rnus = 100", ["key 'rnus'", "one of network", "closest: 'runs'"]),
    "missing key": ("runs = 100\n", "", ["runs", "positive whole number", "none"]),
    "no horizon": ("horizon = 4", "horizon = 0", ["horizon", "positive whole number", "0"]),
    "seed": ("seed = 5", "seed = -1", ["seed", "from 0 to 4294967295", "-1"]),
    "chunk": ("chunk = 64", "chunk = 100", ["chunk", "a multiple of 32", "100"]),
    "keep": ("seed = 5", 'keep = "all"', ["keep", "'errors' or 'trajectories'", "'all'"]),
    "no function": ("net.py:build", "net.py", ["network", "my_network.py:build", "'net.py'"]),
    "no file": ("net.py:build", "nets.py:build", ["network", "a Python file", "nets.py: nothing of that name"]),
    "no such function": ("net.py:build", "net.py:built", ["net.py:built", "a function", "an unknown name"]),
    "no settings": (CAMPAIGN[CAMPAIGN.index("[grid]") :], "", ["either [grid] or [[settings]]", "neither"]),
    "both": ("[grid]", "[[settings]]\ngain = 1\n[grid]", ["either [grid] or [[settings]]", "both"]),
    "no list": ("gain = [0.5, 0.7, 0.9]", "gain = 0.5", ["grid.gain", "a list of values", "0.5"]),
    "twice": ("[0.5, 0.7, 0.9]", "[0.5, 0.5]", ["setting 2", "distinct settings", "the same as setting 0"]),
    "not finite": ("[0.5, 0.7, 0.9]", "[0.5, nan]", ["gain of setting 2", "finite numbers", "nan"]),
    "a date": ("[0.5, 0.7, 0.9]", "[2020-01-01]", ["gain of setting 0", "finite numbers", "datetime.date"]),
    "taken name": ("noise = [", "filter = [", ["parameter 'filter'", "a Python name other than", "filter"]),
    "unknown argument": ("noise = [", "nosie = [", ["setting 0", "net.py:build(gain, noise=0.1", "'nosie'"]),
    "missing argument": ("gain = [0.5, 0.7, 0.9]\n", "", ["setting 0", "'gain'"]),
    "inputs": ("[grid]", "[inputs]\npush = [1, 2]\n[grid]", ["inputs.push", "one for each of 4 steps", "2 values"]),
}


@pytest.mark.parametrize("case", BAD)
def test_a_campaign_that_is_none(tmp_path, case):
    old, new, fragments = BAD[case]
    assert CAMPAIGN.count(old) == 1
    with pytest.raises(ValueError) as caught:
        write(tmp_path, CAMPAIGN.replace(old, new))
    message = str(caught.value)
    assert "\n" not in message and ": expected " in message and ", got " in message
    for fragment in fragments:
        assert fragment in message


def test_no_campaign(tmp_path):
    with pytest.raises(ValueError, match=r"a TOML file, got nothing of that name"):
        load_campaign(tmp_path / "no.toml")


def test_a_network_that_does_not_run(tmp_path):
    with pytest.raises(ValueError, match=r"network net.py: expected Python that runs, got ZeroDivisionError in line 1"):
        write(tmp_path, network="1 / 0\n" + NETWORK)
