"""A small campaign that compiles quickly and whose work can be slowed, made to fail and made to die from outside."""

from pathlib import Path

from heliograph.campaign.campaign_file import load_campaign
from heliograph.campaign.definition import Campaign

NETWORK = """
import os
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp

import heliograph as hg


class Bare(hg.filters.AbstractFilter):
    claim: str = eqx.field(static=True, default="none")
    states: tuple = eqx.field(static=True, default=("x",))
    inputs: tuple = eqx.field(static=True, default=())
    received: int = eqx.field(static=True, default=0)

    def init(self):
        return jnp.zeros(1)

    def predict(self, state, u=(), k=0):
        return state

    def correct(self, state, z, k=0):
        return state, hg.model.Innovation(z, jnp.zeros((0, 0)), 0.0)

    def estimate(self, state):
        return hg.model.Estimate(state, jnp.full((1, 1), jnp.nan), self.claim)


def build(gain, noise=0.1, kind="linear"):
    time.sleep(float(os.environ.get("PAUSE", "0")))
    trouble = Path(os.environ.get("TROUBLE", "nowhere"))
    if gain == 0.7 and trouble.is_file():
        if trouble.read_text() == "die":
            os._exit(9)
        if trouble.read_text() == "die once":
            trouble.unlink()
            os._exit(9)
        raise RuntimeError("no such gain")
    plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 0.3, states=["x"])
    link = hg.hop(hg.Rayleigh(gain), noise)
    sensor = hg.LinearSensor([[1.0]], 0.05)
    filters = {"trusting": hg.mean_gain_filter(plant, sensor, link)}
    nodes = {"near": hg.Node(sensor, link, filters)}
    if kind == "two":
        nodes = {"far": hg.Node(sensor, link, {"other": Bare()}), **nodes}
    return hg.Network(plant, nodes)
"""
CAMPAIGN = """
network = "net.py:build"
horizon = 4
runs = 100
seed = 5
chunk = 64

[grid]
gain = [0.5, 0.7, 0.9]
noise = [0.1, 0.2]
"""
CHUNKS = 12  # 3 x 2 settings of 64 + 36 runs


def write(folder: Path, campaign: str = CAMPAIGN, network: str = NETWORK) -> Campaign:
    (folder / "net.py").write_text(network)
    (folder / "campaign.toml").write_text(campaign)
    return load_campaign(folder / "campaign.toml")


def contents(out: Path) -> dict[str, bytes]:
    """Every file of the store, and the table."""
    files = [*(out / "results.zarr").rglob("*"), out / "summary.csv"]
    return {str(path.relative_to(out)): path.read_bytes() for path in files if path.is_file()}


def chunk_files(out: Path) -> list[Path]:
    return sorted((out / "results.zarr" / "error").glob("c.*"))
