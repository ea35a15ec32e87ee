"""A reducer of two in one program."""

import heliograph as hg
from heliograph.simulation.results.reducer import AbstractReducer, OfStep, Trajectories


class Both(AbstractReducer):
    """Trajectories and statistics of the same runs, so that XLA compiles one program for the two."""

    def of_step(self, step):
        record, sums = Trajectories().of_step(step), hg.Statistics().of_step(step)
        return OfStep(sums=sums.sums, ever=sums.ever, collected=(record.collected, sums.collected))

    def summed(self, sums, common, count):
        return hg.Statistics().summed(sums, common, count)

    def finish(self, carry, collected, network):
        record, sums = collected
        return Trajectories().finish((), record, network), hg.Statistics().finish(carry, sums, network)

    def others(self, filtered, smoothed, claims):
        reducers = Trajectories(), hg.Statistics()
        return tuple(reducer.others(*both, claims) for reducer, *both in zip(reducers, filtered, smoothed, strict=True))
