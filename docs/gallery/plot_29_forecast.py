"""
What will arrive is forecast with its band
==========================================

A level behind a relay that fades. The best linear filter knows that the gain is random; the one that takes the mean
for the gain is too sure, most of all a few steps ahead. Over 400 runs the first band holds the truth as often as it
says.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.98]], 0.1, [0.0], 4.0, states=["level"])
sensor = hg.LinearSensor([[1.0]], 0.1, outputs=["level"])
link = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.05), hg.hop(hg.Rayleigh(0.8), 0.05)])
filters = {"gain random": hg.linear_filter(plant, sensor, link), "mean gain": hg.mean_gain_filter(plant, sensor, link)}
network = hg.Network(plant, {"far": hg.Node(sensor, link, filters)})
rows, ahead, runs = 60, 25, 400

simulated = hg.monte_carlo(network, rows + ahead, runs, 2)
inside = {name: np.zeros(ahead) for name in filters}
for run in range(runs):
    record = simulated.of_run(run)
    found = hg.run(network, {"far": record.measurements["far"][:rows]})
    forecasts = hg.forecast(found, ahead)["far"]
    for name, forecast in forecasts.items():
        low, high = forecast.states.interval(0.8)
        inside[name] += ((low < record.truth[rows:]) & (record.truth[rows:] < high))[:, 0] / runs

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 5.2), layout="constrained", height_ratios=[2, 1])
above.plot(np.arange(rows + ahead), record.truth[:, 0], color="0.25", linestyle=":", label="truth")
for colour, (name, forecast) in zip(("#0072b2", "#d55e00"), forecasts.items(), strict=True):
    estimate = found.estimates["far"][name]
    above.plot(found.time, estimate.mean[:, 0], color=colour, linewidth=1)
    low, high = forecast.states.interval(0.8)
    above.plot(forecast.time, forecast.states.mean[:, 0], color=colour, label=name)
    above.fill_between(forecast.time, low[:, 0], high[:, 0], color=colour, alpha=0.2, linewidth=0)
    below.plot(np.arange(1, ahead + 1), inside[name], color=colour)
above.axvline(rows - 0.5, color="0.4", linewidth=1)
above.set(xlabel="step", ylabel="level", title="Forecasts with bands of 80 % behind the line where data end")
above.legend(frameon=False, loc="upper left", ncols=3)
below.axhline(0.8, color="0.4", linewidth=1)
below.set(xlabel="steps ahead", ylabel="share inside", ylim=(0, 1), title="How often the band held the truth")
