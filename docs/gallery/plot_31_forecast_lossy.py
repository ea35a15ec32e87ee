"""
A forecast through a lossy link, and what the mean gain makes of it
===================================================================

A tank's level, measured behind a relay that fades and loses one message of five, forecast for twelve hours. Both
filters have the same data. The one that knows the law of the gain says how wrong it may be, and is as often right as it
says; the one that takes the mean for the gain is not.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[1.0]], 0.04, [6.0], 1.0, states={"level": "m"})
sensor = hg.LinearSensor([[1.0]], 0.01, outputs=["level"])
link = hg.amplify_and_forward([hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.02), hg.hop(hg.Rayleigh(0.8), 0.02)])
filters = {"knows the link": hg.linear_filter(plant, sensor, link),
           "trusts the mean gain": hg.mean_gain_filter(plant, sensor, link)}  # fmt: skip
network = hg.Network(plant, {"tank": hg.Node(sensor, hg.erasure(link, 0.8), filters)})
rows, ahead, runs, coverage = 36, 12, 300, 0.8

simulated = hg.monte_carlo(network, rows + ahead, runs, 4)
inside = dict.fromkeys(filters, 0.0)
for run in range(runs):
    record = simulated.of_run(run)
    found = hg.run(network, {"tank": record.measurements["tank"][:rows]})
    forecasts = hg.forecast(found, ahead)["tank"]
    for name, forecast in forecasts.items():
        low, high = forecast.states.interval(coverage)
        inside[name] += np.mean((low < record.truth[rows:]) & (record.truth[rows:] < high)) / runs

figure, panels = plt.subplots(1, 2, figsize=(9.2, 3.4), sharey=True, layout="constrained")
for panel, colour, (name, forecast) in zip(panels, ("#0072b2", "#d55e00"), forecasts.items(), strict=True):
    estimate, hours = found.estimates["tank"][name], np.arange(rows + ahead)
    deviation = np.sqrt(np.asarray(estimate.covariance)[:, 0, 0])
    mean = np.concatenate([np.asarray(estimate.mean)[:, 0], forecast.states.mean[:, 0]])
    half = 1.2816 * np.concatenate([deviation, forecast.states.deviation[:, 0]])  # 80 %
    panel.plot(hours, record.truth[:, 0], color="0.2", linestyle=":", label="true level")
    panel.plot(hours, mean, color=colour, label="estimate, forecast")
    panel.fill_between(hours, mean - half, mean + half, color=colour, alpha=0.22, linewidth=0, label="band of 80 %")
    panel.axvline(rows - 0.5, color="0.5", linewidth=1)
    panel.set_title(f"{name}: {inside[name]:.0%} of forecasts inside", fontsize=10, loc="left")
    panel.set_xlabel("hour")
    panel.spines[["top", "right"]].set_visible(False)
panels[0].set_ylabel("level in m")
_ = panels[0].legend(frameon=False, fontsize=8, loc="lower left")
