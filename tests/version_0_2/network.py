import heliograph as hg

plant = hg.LinearPlant(
    [[1.0, 1.0], [0.0, 0.9]],
    [[0.02, 0.01], [0.01, 0.3]],
    [0.0, 1.0],
    [[2.0, 0.5], [0.5, 1.0]],
    [[0.0], [1.0]],
    inputs=["push"],
    states=["place", "speed"],
)
sensor, hop = hg.LinearSensor([[1.0, 0.0]], 0.1), hg.hop(hg.Discrete([0.6, 1.2], [0.5, 0.5]), 0.05)
fades = hg.markov_fading([0.4, 1.0], [[0.8, 0.2], [0.1, 0.9]], noise=0.05)
near = {"linear": hg.linear_filter(plant, sensor, hop), "cubature": hg.cubature_filter(plant, sensor, hop)}
far = {"linear": hg.linear_filter(plant, sensor, fades), "imm": hg.filters.imm_filter(plant, sensor, fades)}
nodes = {"a": hg.Node(sensor, hop, near), "b": hg.Node(sensor, fades, far)}
network = hg.Network(plant, nodes, {"both": hg.Fusion("linear", hg.fusion.EqualIntersection())})
