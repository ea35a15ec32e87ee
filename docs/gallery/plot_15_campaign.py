"""
Many settings: a campaign
=========================

How does the error depend on the fading and on the losses? A campaign simulates one network in many
settings and keeps everything in one labelled store. It can be interrupted at any moment and started again.
From the command line it is ``heliograph sweep campaign.toml --out results``; here the same in Python.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

NETWORK = """
import heliograph as hg

def build(noise, arrival):
    plant = hg.LinearPlant([[0.95]], noise=0.1, initial_mean=[0.0], initial_covariance=1.0, states=["level"])
    sensor = hg.LinearSensor([[1.0]], noise=0.05)
    link = hg.dropout(hg.hop(hg.Rayleigh(1.0), noise), arrival)
    filters = {"linear": hg.linear_filter(plant, sensor, link)}
    return hg.Network(plant, {"remote": hg.Node(sensor, link, filters)})
"""
CAMPAIGN = """
network = "my_network.py:build"
horizon = 20
runs = 256

[grid]
noise = [0.01, 0.1, 1.0]
arrival = [0.5, 0.75, 1.0]
"""
folder = Path(tempfile.mkdtemp())
(folder / "my_network.py").write_text(NETWORK)
(folder / "campaign.toml").write_text(CAMPAIGN)
campaign = hg.campaign.load_campaign(folder / "campaign.toml")
done = hg.campaign.run_campaign(campaign, folder / "results", workers=0)
print(done.computed, "parts computed,", len(done.failures), "failed")

# %%
# The results are an ``xarray.Dataset``, with the settings as coordinates.

results = hg.campaign.open_results(folder / "results")
error = results.error.sel(node="remote", filter="linear", state="level")
rms = np.sqrt((error**2).mean(["run", "time"])).values
fig, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
for noise in (0.01, 0.1, 1.0):
    chosen = results.noise.values == noise
    ax.plot(results.arrival.values[chosen], rms[chosen], "o-", label=f"noise {noise:g}")
ax.set(xlabel="probability that a packet arrives", ylabel="RMS error", ylim=(0, None))
_ = ax.legend()
