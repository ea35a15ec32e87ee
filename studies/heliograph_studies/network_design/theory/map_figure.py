"""A map of the error over the sites of a relay."""

import matplotlib
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, INK, MUTED, STYLE, VERMILION, WIDTH
from heliograph_studies.network_design.theory.relay_sites import RelayMap

LEVELS = 14
MOST = 1.3  # height of a map, of its width


@matplotlib.rc_context(STYLE)
def site_map(result: RelayMap) -> Figure:
    """Error by the site of one relay, with sensors, receiver, the relays that were placed, and the ways taken."""
    wide, high = float(result.x.max() - result.x.min()), float(result.y.max() - result.y.min())
    share = min(max(high / wide if wide else 1.0, 0.3), MOST)
    figure = Figure(figsize=(WIDTH, WIDTH * 0.85 * share + 0.9), layout="constrained")
    axes = figure.subplots()
    scene = result.scene
    filled = axes.contourf(result.x, result.y, result.errors, LEVELS, cmap="cividis")
    for start, relay in zip(scene.sensors, scene.ways(result.sites, result.total)[1], strict=True):
        way = [start, *([result.sites[relay]] if relay >= 0 else []), scene.receiver]
        axes.plot(*zip(*way, strict=True), color=INK, linewidth=0.8, alpha=0.6)
    for points, mark, colour, name, size in (
        (scene.sensors, "^", AMBER, "sensors", 8),
        (scene.receiver[None], "s", BLUE, "receiver", 8),
        (result.sites, "o", VERMILION, "relays" if len(result.sites) > 1 else "relay", 9),
    ):
        axes.plot(*points.T, mark, color=colour, markeredgecolor=INK, markersize=size, label=name, zorder=5)
    axes.set(
        title=f"Error by the site of one relay ({result.direct:.4g} without)", aspect="equal", xlabel="x", ylabel="y"
    )
    axes.grid(False)
    figure.colorbar(filled, ax=axes, label="steady error").outline.set_edgecolor(MUTED)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return figure
