"""Where relays stand in the plane: a map of the error over sites, sites by descent, and sites chosen of some."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from scipy.optimize import minimize

from heliograph.numerics.check import array, check_count, fail, instance, scalar
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph_studies.network_design.theory.choose import COMPARED, Choice, greedy, swapped
from heliograph_studies.network_design.theory.relay_scene import RelayScene


@readable
@dataclass(frozen=True)
class RelayMap:
    """Steady error with one relay at each site of a grid, errors (len(y), len(x)); direct: without one.

    sites: of the relays that were placed, (R, 2), and their error. bound: proven, no relays at any sites come below.
    starts: descents that were tried.
    """

    scene: RelayScene
    total: float
    x: Float[np.ndarray, "columns"]
    y: Float[np.ndarray, "rows"]
    errors: Float[np.ndarray, "rows columns"]
    direct: float
    sites: Float[np.ndarray, "R 2"]
    error: float
    bound: float
    starts: int

    @property
    def words(self) -> str:
        """How good the sites are, in a line."""
        return f"best of {self.starts} starts; no sites can be better than {self.bound:.6g}, {self.direct:.6g} without"


def relay_map(
    scene: RelayScene, total: ArrayLike, x: Sequence[float], y: Sequence[float], relays: int = 1, starts: int = 3
) -> RelayMap:
    """The error over the sites x, y of one relay, and good sites of so many relays, at a total power.

    Each relay begins at one of the best places of the grid with those before it; from the `starts` best of the first
    all sites then move downhill together.

    Raises:
        ValueError: no power, an empty grid.
    """
    instance("scene", scene, RelayScene, "a RelayScene")
    power = float(scalar("total power", total, np.finfo(float).tiny))
    xs, ys = array("x of a map", x, (None,)), array("y of a map", y, (None,))
    if not len(xs) or not len(ys):
        raise fail("grid of a map", "at least one site", "none")
    count, tries = check_count("relays", relays), check_count("starts", starts)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1)
    errors = np.array([[scene.error(site, power) for site in row] for row in grid])
    flat = grid.reshape(-1, 2)
    begun = [flat[i][None] for i in np.argsort(errors, axis=None, kind="stable")[:tries]]
    ends = [_descended(scene, power, _completed(scene, power, flat, sites, count)) for sites in begun]
    error, sites = min(ends, key=lambda pair: pair[0])
    direct = scene.error(np.zeros((0, 2)), power)
    return RelayMap(scene, power, xs, ys, errors, direct, sites, error, min(scene.bound(power), error), len(begun))


def choose_relays(
    scene: RelayScene, total: ArrayLike, sites: ArrayLike, count: int, compared: int = COMPARED
) -> Choice:
    """The `count` sites (R, 2) for relays at which the steady error is least, at a total power.

    All choices are compared if they are no more than `compared`; else greedy choice is bettered by swaps. The bound is
    the error with relays at all the sites.

    Raises:
        ValueError: no power, more relays than sites.
    """
    instance("scene", scene, RelayScene, "a RelayScene")
    power = float(scalar("total power", total, np.finfo(float).tiny))
    places = array("sites of relays", sites, (None, 2))
    if check_count("relays to choose", count) > len(places):
        raise fail("relays to choose", f"at most the {len(places)} sites there are", count)

    def of(chosen: tuple[int, ...]) -> float:
        return scene.error(places[list(chosen)], power)

    exact = comb(len(places), count) <= compared
    every = combinations(range(len(places)), count)
    best = min(every, key=of) if exact else swapped(of, len(places), greedy(of, len(places), count))
    return Choice(best, of(best), min(scene.error(places, power), of(best)), exact)


def _completed(
    scene: RelayScene, total: float, grid: Float[np.ndarray, "k 2"], sites: np.ndarray, count: int
) -> np.ndarray:
    """Relays added one by one, each at the best place of the grid."""
    while len(sites) < count:
        tried = [np.concatenate([sites, site[None]]) for site in grid]
        sites = min(tried, key=lambda places: scene.error(places, total))
    return sites


def _descended(scene: RelayScene, total: float, sites: np.ndarray) -> tuple[float, np.ndarray]:
    """The error is not smooth where a sensor changes its way: a simplex moves downhill.

    Its first steps are twentieths of coordinates, here of 1 to 2.
    """
    everything = np.append(scene.sensors, scene.receiver[None], axis=0)
    corner = everything.min(axis=0)
    size = max(float(np.ptp(everything, axis=0).max()), scene.radio.nearest)

    def error(z: np.ndarray) -> float:
        return scene.error((z.reshape(-1, 2) - 1) * size + corner, total)

    start: np.ndarray = ((sites - corner) / size + 1).ravel()
    most = 400 * len(start)
    search = minimize(error, start, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12, "maxiter": most})
    if search.fun >= scene.error(sites, total):
        return scene.error(sites, total), sites
    return float(search.fun), (np.asarray(search.x).reshape(-1, 2) - 1) * size + corner
