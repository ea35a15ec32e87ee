"""Who sends when: schedules that repeat, all of them compared for short periods, with a bound that no schedule beats.

Schedules that are rotations of each other are the same: of words over the choices of a step one stands for its
rotations, the first of them in order (a necklace).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import check_count, fail
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike
from heliograph.planning.error import Error
from heliograph.planning.paths.information_filter import updated
from heliograph.planning.paths.model import Paths
from heliograph_studies.network_design.theory.choose import COMPARED, SensorSet, sensor_set, shared

Steps = tuple[tuple[int, ...], ...]  # the sensors of each step

LONGEST = 400  # steps after which a greedy schedule that does not repeat itself is cut
SAME = 1e-9  # relative difference of covariances that count as repeated


@readable
class SendingSchedule(NamedTuple):
    """Sensors that send at each step of a period.

    error: its mean over the period. bound: proven, no schedule of any period that lets as many send at each step has a
    smaller one. by_period: of the best schedule of each period. exact: the periods of which every schedule was
    compared. greedy: mean error of taking at each step those that lower the error of that step most.
    """

    steps: Steps
    error: float
    bound: float
    by_period: dict[int, float]
    exact: tuple[int, ...]
    greedy: float

    @property
    def words(self) -> str:
        """How good the schedule is, in a line."""
        every = f"all schedules of periods {', '.join(map(str, self.exact))} were compared; " if self.exact else ""
        return f"{every}nothing of any period can be better than {self.bound:.6g}"


def best_schedule(
    paths: Paths,
    powers: ArrayLike,
    periods: Iterable[int] = range(1, 5),
    at_once: int = 1,
    error: Error | None = None,
    states: tuple[str, ...] | None = None,
    compared: int = COMPARED,
) -> SendingSchedule:
    """The schedule of least mean error in which `at_once` sensors send at each step, with their `powers` when on.

    All necklaces of a period are compared if they are no more than `compared`; else the best schedules of shorter
    periods and the greedy one are bettered, a step at a time, until no change of one step helps.

    Raises:
        ValueError: no periods, more sensors at once than there are, paths that are not steady.
    """
    case = sensor_set(paths, powers, error, states)
    lengths = sorted({check_count("period", period) for period in periods})
    if not lengths:
        raise fail("periods", "at least one", "none")
    if check_count("sensors at once", at_once) > len(case.information):
        raise fail("sensors at once", f"at most the {len(case.information)} there are", at_once)
    choices = list(combinations(range(len(case.information)), at_once))

    def of(steps: Steps) -> float:
        return case.error(case.on(steps))

    greedy = _greedy(case, choices)
    best: dict[int, Steps] = {}
    exact = tuple(period for period in lengths if len(choices) ** period <= compared * period)
    for period in lengths:
        if period in exact:
            words = necklaces(len(choices), period)
            best[period] = min((tuple(choices[i] for i in word) for word in words), key=of)
        else:
            starts = [_stretched(steps, period) for steps in (*best.values(), greedy)]
            best[period] = min((_bettered(of, choices, start) for start in starts), key=of)
    errors = {period: of(steps) for period, steps in best.items()}
    shortest = min(errors, key=lambda period: errors[period])
    bound = min(shared(case, at_once)[1], errors[shortest])
    return SendingSchedule(best[shortest], errors[shortest], bound, errors, exact, of(greedy))


def necklaces(letters: int, length: int) -> Iterator[tuple[int, ...]]:
    """Words over 0 .. letters - 1 of which none is a rotation of another."""
    for word in product(range(letters), repeat=length):
        if all(word <= word[i:] + word[:i] for i in range(1, length)):
            yield word


def _stretched(steps: Steps, period: int) -> Steps:
    return tuple(steps[k % len(steps)] for k in range(period))


def _bettered(of: Callable[[Steps], float], choices: Sequence[tuple[int, ...]], steps: Steps) -> Steps:
    """The best change of one step, again and again."""
    value = of(steps)
    while True:
        changed = [(*steps[:k], new, *steps[k + 1 :]) for k in range(len(steps)) for new in choices if new != steps[k]]
        if not changed or of(best := min(changed, key=of)) >= value:
            return steps
        steps, value = best, of(best)


def _greedy(case: SensorSet, choices: Sequence[tuple[int, ...]]) -> Steps:
    """Those that lower each step's error most, until choices and covariance repeat themselves."""
    a, q = case.plants.transition[0], case.plants.process[0]
    informations = np.array([case.information[list(choice)].sum(axis=0) for choice in choices])
    p = q
    seen: list[np.ndarray] = []
    taken: list[int] = []
    for _ in range(LONGEST):
        predicted = a @ p @ a.T + q
        after = [updated(predicted, information) for information in informations]
        best = int(np.argmin([np.sum(case.weight * covariance) for covariance in after]))
        p = after[best]
        for k, before in enumerate(seen):
            if taken[k] == best and np.abs(before - p).max() <= SAME * np.abs(p).max():
                return tuple(choices[i] for i in (*taken[k + 1 :], best))
        seen.append(p)
        taken.append(best)
    return tuple(choices[i] for i in taken[LONGEST // 2 :])
