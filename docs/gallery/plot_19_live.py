"""
A service, and messages that come late
======================================

``heliograph serve`` keeps filters running: messages go in, estimates come out. Inside it is a ``Service``, which knows
no pipe and no broker, and can be fed from Python. Here a recording is replayed through a radio link that delays,
loses and doubles messages. After each message the service tells what is known now, which is provisional: what
comes late may still change it. What is older than the window is final, and published once.
"""

import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg
from heliograph.serving import (
    Fleet,
    InMemoryStore,
    Link,
    NetworkProgram,
    Options,
    Service,
    encode_messages,
    recorded,
    simulate_link,
)

turn = 0.15 * np.array([[0.0, 1.0], [-1.0, 0.0]])  # an oscillation of some forty steps
plant = hg.LinearPlant(np.eye(2) + turn, np.diag([0.01, 0.4]), [0.0, 3.0], 0.1 * np.eye(2), states=["x", "v"])
sensor = hg.LinearSensor([[1.0, 0.0]], 0.05, outputs=["place"])
hop = hg.hop(hg.random_affine.Rician(1.0, 0.1), noise=0.05)
network = hg.Network(plant, {"radio": hg.Node(sensor, hop, {"aware": hg.linear_filter(plant, sensor, hop)})})
recording = hg.monte_carlo(network, 60, runs=1, key=3)
truth = recording.truth[0, :, 0]

file = Path(tempfile.mkdtemp()) / "recording.csv"
rows = np.column_stack([np.arange(60.0), recording.measurements["radio"][0]])
np.savetxt(file, rows, delimiter=",", header="time,place", comments="")
sent, origin = recorded(file, network)
received = simulate_link(sent, Link(loss=0.1, delay=2.0, duplicates=0.1), seed=0)
service = Service(Fleet(NetworkProgram(network), Options(window=5.0)), InMemoryStore())
known = []  # what comes out, with the moment at which it does
for arrival, message in encode_messages(received, plant="", origin=origin):
    known += [(arrival, json.loads(output.body)) for output in service.take([message.encode()])]
known += [(received[-1].arrival, json.loads(output.body)) for output in service.finish(ended=True)]


first = {}  # what was published of a step while it was the newest
final = {}
for _, message in known:
    if message["kind"] != "refused":
        claimed = message["estimates"]["radio"]["aware"]
        estimate = claimed["mean"][0], np.sqrt(claimed["covariance"][0][0])
        (first if message["kind"] == "provisional" else final).setdefault(message["time"], estimate)

fig, (top, bottom) = plt.subplots(2, 1, figsize=(9, 5.2), sharex=True, height_ratios=[3, 2], layout="constrained")
for name, result, color, shift in (
    ("provisional, at first", first, "C1", -0.15),
    ("final", final, "C0", 0.15),
):
    times = np.array(list(result))
    mean, deviation = np.transpose(list(result.values()))
    error = mean - truth[times.astype(int)]
    top.errorbar(times + shift, error, 2 * deviation, fmt=".", color=color, elinewidth=2, alpha=0.8, label=name)
    print(f"{name}: RMS error {np.sqrt(np.mean(error**2)):.3f}, {len(result)} steps")
top.axhline(0.0, color="k", lw=1)
top.set(ylabel="position, estimate - truth", title="Errors, with two claimed deviations")
top.legend(fontsize=8, ncols=2)

refused = {(item["sequence"], at): item["reason"] for at, item in known if item["kind"] == "refused"}
colors = {"used": "C0", "late": "C3", "duplicate": "0.6"}
for place, event in enumerate(received):
    verdict = refused.get((event.sequence, event.arrival), "used")
    bottom.plot([event.time, event.arrival], [place % 7] * 2, colors[verdict], lw=2)
    bottom.plot(event.arrival, place % 7, ">", color=colors[verdict], ms=4)
for verdict, color in colors.items():
    bottom.plot([], [], color, label=verdict)
bottom.set(xlabel="time (steps)", yticks=[], ylim=(-1, 9))
bottom.legend(fontsize=8, ncols=3, loc="upper center")

# %%
# Both kinds are honest. A provisional estimate knows less, and says so: its bar is longer. The final one is that of a
# filter that received all that came within the window, in the order of time. A copy changes nothing, and what
# comes later than the window is refused. Each of them is published, with the reason.

print(json.dumps(next(item for _, item in known if item.get("reason") == "late"), indent=1))
