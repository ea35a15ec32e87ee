"""Small networks of neighbours, and their errors worked out from every source of noise, in NumPy alone."""

import numpy as np

import heliograph as hg

PLANT = hg.LinearPlant([[1.02, 0.3], [0.0, 0.9]], [[0.2, 0.05], [0.05, 0.1]], [1.0, -2.0], [[1.0, 0.2], [0.2, 0.5]])
LINK = hg.erasure(hg.perfect(), 0.7)
RULES = {
    "best": hg.fusion.MatrixWeights(),
    "trace": hg.fusion.TraceIntersection(),
    "diffusion": hg.fusion.DiffusionWeights(),
}
ROWS = {"a": ([[1.0, 0.0]], 0.3), "c": ([[0.4, 1.0]], 0.5), "d": ([[1.0, 0.2], [0.0, 1.0]], np.diag([0.8, 1.5]))}
RING = {"a": ["b"], "b": ["c", "d"], "c": ["a", "b"], "d": ["c"]}  # b has no sensor
NODES = ("a", "b", "c", "d")


def network(rules, neighbours=RING, link=None, rounds=1, plant=PLANT, rows=ROWS):
    """Nodes with these rows of measurements, and a fusion between neighbours by each of these rules."""
    names = sorted(set(neighbours) | {name for mine in neighbours.values() for name in mine})
    nodes = {name: None for name in names}
    for name, (matrix, noise) in rows.items():
        sensor = hg.LinearSensor(matrix, noise)
        nodes[name] = hg.Node(sensor, hg.perfect(len(matrix)), {"own": hg.kalman_filter(plant, sensor)})
    fused = {k: hg.Fusion("own", r, neighbours=neighbours, link=link, rounds=rounds) for k, r in rules.items()}
    return hg.Network(plant, nodes, fused)


def models(plant=PLANT, rows=ROWS, names=NODES):
    """A, Q, P_0, and H_j, R_j of each node, none for a node without a sensor."""
    h = [np.array(rows[name][0]) if name in rows else np.zeros((0, len(plant.states))) for name in names]
    r = [np.atleast_2d(rows[name][1]) if name in rows else np.zeros((0, 0)) for name in names]
    return np.asarray(plant.matrix), np.asarray(plant.noise.covariance), np.asarray(plant.initial_covariance), h, r


def senders(neighbours=RING, names=NODES):
    """Places of whom each node receives, itself first."""
    return [[i, *(names.index(s) for s in neighbours.get(name, ()))] for i, name in enumerate(names)]


class Sources:
    """Errors of all nodes as linear maps of white sources: x_0, each w, and each node's measurement noise.

    A step is that of the textbook in gain form, rows of measurements stacked; `weights(i, there, believed, joint)`
    gives the weight of each estimate that arrived, and the covariance that is believed after the fusion.
    """

    def __init__(self, weights, plant=PLANT, rows=ROWS, neighbours=RING, names=NODES):
        self.a, self.q, p, self.h, self.r = models(plant, rows, names)
        self.weights, self.receives = weights, senders(neighbours, names)
        self.errors = [np.linalg.cholesky(p) for _ in names]
        self.believed = [p for _ in names]

    @property
    def joint(self):
        """Cov(e_i, e_j), (node, n, node, n)."""
        flat = np.concatenate(self.errors)
        n = len(self.a)
        return (flat @ flat.T).reshape(len(self.errors), n, len(self.errors), n)

    def covariances(self):
        """Cov e_i of all nodes."""
        return np.array([e @ e.T for e in self.errors])

    def step(self, arrived):
        """Step all nodes; `arrived` (node, degree): which of the messages."""
        n, sizes = len(self.a), [len(h) for h in self.h]
        old, joint, believed = self.errors, self.joint, self.believed
        new = n + sum(sizes)
        w = np.pad(np.linalg.cholesky(self.q), ((0, 0), (old[0].shape[1], sum(sizes))))
        starts = np.concatenate([[0], np.cumsum(sizes)]) + old[0].shape[1] + n
        padded = [np.pad(e, ((0, 0), (0, new))) for e in old]
        self.errors, self.believed = [], []
        for i, mine in enumerate(self.receives):
            there = [j for j, arrives in zip(mine, arrived[i], strict=False) if arrives]
            weights, covariance = self.weights(i, there, believed, joint)
            e = self.a @ sum(c @ padded[j] for c, j in zip(weights, there, strict=True)) + w
            predicted = self.a @ covariance @ self.a.T + self.q
            # Rows of all measurements that arrived, stacked.
            h = np.concatenate([self.h[j] for j in there])
            noise = np.zeros((len(h), padded[0].shape[1]))
            row = 0
            for j in there:
                noise[row : row + sizes[j], starts[j] : starts[j] + sizes[j]] = np.linalg.cholesky(self.r[j])
                row += sizes[j]
            r = noise @ noise.T
            gain = predicted @ h.T @ np.linalg.inv(h @ predicted @ h.T + r)
            self.errors.append(e - gain @ (h @ e + noise))
            self.believed.append(predicted - gain @ h @ predicted)


def best(i, there, believed, joint):
    """Best linear unbiased weights by the unified theory of least squares, and W P W'."""
    n = joint.shape[1]
    p = joint[np.ix_(there, range(n), there, range(n))].reshape(len(there) * n, -1)
    e = np.tile(np.eye(n), (len(there), 1))
    inverse = np.linalg.pinv(p + e @ e.T * np.trace(p) / len(p), rcond=1e-9, hermitian=True)
    weights = np.linalg.solve(e.T @ inverse @ e, e.T @ inverse)
    return np.split(weights, len(there), axis=1), weights @ p @ weights.T


def equal(i, there, believed, joint):
    """Intersection with equal shares."""
    information = [np.linalg.inv(believed[j]) / len(there) for j in there]
    covariance = np.linalg.inv(sum(information))
    return [covariance @ item for item in information], covariance


def by_trace(i, there, believed, joint):
    """Intersection with the better of trace^-4 and equal shares."""
    shares = np.array([np.trace(believed[j]) for j in there]) ** -4.0
    information = [s / shares.sum() * np.linalg.inv(believed[j]) for s, j in zip(shares, there, strict=True)]
    covariance = np.linalg.inv(sum(information))
    result = [covariance @ item for item in information], covariance
    other = equal(i, there, believed, joint)
    return result if np.trace(covariance) <= np.trace(other[1]) else other
