"""A network with the statistics of a recorded one, where no recording is at hand.

They are those of the log "tdma 3-1": 10 nodes, a packet of each some 4.8 s apart, 9.9 % lost, 27 % of those that follow
a loss, 15 % of what is received copies, and quantiles of the delay. Here delays are independent, and losses a chain.

Source: Vilgelm, Gürsu, Zoppi, Kellerer, Time slotted channel hopping for smart metering (2016), the data beside it.
"""

import numpy as np

from heliograph_studies.late_data.packets import Packets

NODES = 10
INTERVAL = 4.8  # s
LOST, LOST_AFTER_LOST = 0.099, 0.27
COPIES = 0.15
SHARES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 1.0)
DELAYS = (0.015, 0.075, 0.21, 0.38, 0.65, 1.2, 2.2, 4.2, 5.9, 7.8, 23.0, 85.0)  # s at these shares, log-linear between


def synthetic_packets(duration: float, seed: int) -> Packets:
    """Packets sent during so many seconds, in the order of arrival."""
    generator = np.random.default_rng(seed)
    parts = [_node(node, duration, generator) for node in range(2, NODES + 2)]
    node, sequence, sent, received = (np.concatenate(part) for part in zip(*parts, strict=True))
    again = generator.random(len(node)) < COPIES / (1 - COPIES)
    later = received[again] + generator.exponential(INTERVAL / NODES, again.sum())
    order = np.argsort(np.concatenate([received, later]), kind="stable")
    node, sequence, sent = (np.concatenate([a, a[again]])[order] for a in (node, sequence, sent))
    return Packets(node, sequence, sent, np.concatenate([received, later])[order])


def _node(node: int, duration: float, generator: np.random.Generator) -> tuple[np.ndarray, ...]:
    """What is received of one node."""
    count = int(duration / INTERVAL)
    sent = (np.arange(count) + generator.random(count)) * INTERVAL
    begin = LOST * (1 - LOST_AFTER_LOST) / (1 - LOST)  # of a loss after none, so that LOST of all are lost
    lost = np.zeros(count, dtype=bool)
    for k, chance in enumerate(generator.random(count)):
        lost[k] = chance < (LOST if k == 0 else LOST_AFTER_LOST if lost[k - 1] else begin)
    delay = np.exp(np.interp(generator.random(count), SHARES, np.log(DELAYS)))
    received = ~lost
    return np.full(received.sum(), node), np.flatnonzero(received), sent[received], (sent + delay)[received]
