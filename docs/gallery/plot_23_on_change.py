"""
Rooms that report on change
===========================

A sensor that reports only when its value has changed by half a kelvin says something by its silence: not much
changed, or it was lost. Taking silence for missing gives that away, and claims too much; taking the last value for a
measurement errs by up to twice what it claims where the link fails for a while at a time. The event filter knows the
rule.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

delta, noise = 0.5, 0.1  # kelvin
rule = hg.SendOnDelta(delta, heartbeat=120)
sensor = hg.LinearSensor([[1.0]], noise**2)
failing = hg.gilbert_elliott(hg.erasure(hg.perfect(), 1.0), hg.erasure(hg.perfect(), 0.0), fail=0.02, recover=0.1)


def room(minutes, deviation):
    """Temperature about its mean, and what its thermometer sent."""
    a = np.exp(-1 / minutes)
    plant = hg.LinearPlant([[a]], deviation**2 * (1 - a * a), [0.0], deviation**2)
    filters = {
        "silence taken for missing": hg.kalman_filter(plant, sensor),
        "event filter": hg.event_filter(plant, sensor, failing, rule),
    }
    node = hg.Node(sensor, failing, filters, trigger=rule)
    return a, hg.monte_carlo(hg.Network(plant, {"room": node}), 360, runs=16, key=0)


def last_value(a, deviation, z):
    """Squared error over claim of who takes the last value for a measurement at each step: means and variances."""
    mean, variance, held = np.zeros(len(z)), np.full(len(z), deviation**2), np.full(len(z), np.nan)
    for row in z.T:
        held = np.where(np.isnan(row), held, row)
        mean, variance = a * mean, a * a * variance + deviation**2 * (1 - a * a)
        gain = variance / (variance + noise**2 + np.where(np.isnan(row), delta**2 / 3, 0.0))
        gain = np.where(np.isnan(held), 0.0, gain)
        mean, variance = mean + gain * (np.nan_to_num(held) - mean), variance * (1 - gain)
        yield mean, variance


rooms = list(zip(np.geomspace(30, 300, 10), np.linspace(0.9, 1.8, 10), strict=True))[::3]
ratios = {"the last value as a measurement": [], "silence taken for missing": [], "event filter": []}
for minutes, deviation in rooms:
    a, record = room(minutes, deviation)
    mean, variance = np.moveaxis(np.array(list(last_value(a, deviation, record.measurements["room"][..., 0]))), 0, -1)
    ratios["the last value as a measurement"].append(np.mean((record.truth[..., 0] - mean) ** 2 / variance))
    for name, estimate in record.estimates["room"].items():
        squares = record.errors("room", name)[..., 0] ** 2
        ratios[name].append(np.mean(squares / estimate.covariance[..., 0, 0]))

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
for color, (name, values) in zip(("C3", "C1", "C0"), ratios.items(), strict=True):
    left.semilogy([minutes for minutes, _ in rooms], values, f"{color}o-", label=name)
left.axhline(1.0, color="0.5", lw=1)
left.set(xlabel="minutes in which a room follows", ylabel="squared error over claimed", ylim=(0.4, 6))
left.set_yticks([0.5, 1, 2, 4], ["1/2", "1", "2", "4"], minor=False)
left.minorticks_off()
left.legend(fontsize=7)

plant = hg.LinearPlant([[np.exp(-1 / 108)]], 1.4**2 * (1 - np.exp(-2 / 108)), [0.0], 1.4**2)
thresholds = {"a schedule": [hg.Periodic(n) for n in (3, 8, 20, 50)]}
thresholds["on change"] = [hg.SendOnDelta(d) for d in (0.25, 0.5, 0.8, 1.2)]
for color, (name, triggers) in zip(("0.5", "C0"), thresholds.items(), strict=True):
    results = [hg.planning.simulate_rate(plant, sensor, hg.perfect(), t, 16, 360, 0) for t in triggers]
    rates = [60 * result.rate for result in results]
    right.semilogx(rates, [np.sqrt(result.error[0]) for result in results], "o-", color=color, label=name)
bound = [np.sqrt(hg.planning.least_error(plant, sensor, rate / 60)) for rate in rates]
right.semilogx(rates, bound, "k--", lw=1, label="least error of any sender")
right.set(xlabel="messages an hour", ylabel="error (K)", ylim=(0, None))
right.set_xticks([1, 3, 10, 20], ["1", "3", "10", "20"], minor=False)
_ = right.legend(fontsize=8)
