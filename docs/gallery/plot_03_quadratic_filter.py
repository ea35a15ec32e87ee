"""
Skewed noise: a filter that uses squares
========================================

The Kalman filter is the best *linear* filter whatever the noise. If the noise is skewed (many small
values on one side, few large ones on the other), a filter that also receives the square of each
measurement knows more. How much more follows from the model, before there is any data.
"""

import matplotlib.pyplot as plt

import heliograph as hg

# Usually a little negative, and now and then far above.
rare = hg.random_affine.FiniteSupport([[-0.075], [0.3]], [0.8, 0.2])
bursts = hg.random_affine.FiniteSupport([[-0.75], [3.0]], [0.8, 0.2])
plant = hg.LinearPlant([[0.9]], rare, [0.0], [[0.1]])
sensor = hg.LinearSensor([[1.0]], bursts)
link = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), noise=0.01)

worth = hg.linear.gain_over_linear(plant, sensor, link, horizon=30, degrees=(2, 3))
for degree in (2, 3):
    print(f"degree {degree}: {worth.gain(degree)[0]:.1%} less error variance than the linear filter")
print(f"largest skewness of the model: {worth.skewness:.2f} (0: squares would bring nothing)")

# %%
# The claims of these filters are exact, also behind the random gain. Simulated, they have what they claim:

names = {1: "linear", 2: "quadratic", 3: "cubic"}
filters = {name: hg.polynomial_filter(plant, sensor, link, horizon=30, degree=degree) for degree, name in names.items()}
network = hg.Network(plant, {"node": hg.Node(sensor, link, filters)})
result = hg.monte_carlo(network, horizon=30, runs=2048, key=0, keep=hg.Statistics())["node"]

fig, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
for place, (degree, name) in enumerate(names.items()):
    claimed = worth.covariance[degree][10:, 0, 0].mean()
    has = result[name].actual()[10:, 0, 0].mean()
    ax.bar(place - 0.2, claimed, 0.4, color="C0", label="claimed before any data" if place == 0 else None)
    ax.bar(place + 0.2, has, 0.4, color="C1", label="2,048 simulated runs" if place == 0 else None)
ax.set(xticks=range(3), xticklabels=names.values(), ylabel="error variance")
_ = ax.legend()
