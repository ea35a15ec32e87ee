"""The example's figure, and what its page says beside the numbers."""

from matplotlib.figure import Figure

from heliograph.report.figures import BLUE, GREEN, VERMILION
from heliograph_studies.curves import Curve, paths
from heliograph_studies.live.compute import Outcome
from heliograph_studies.live.killed import WINDOW


def figures(outcome: Outcome) -> dict[str, Figure]:
    """The path of the final estimates, on its map."""
    path = Curve(f"final estimates: {outcome.position_rmse_m:.2f} m off", BLUE, outcome.mean[:, :2])
    return {"map": paths(outcome.truth, [path], outcome.beacons)}


def words(outcome: Outcome) -> dict[str, object]:
    """Colours, and how long late messages are waited for."""
    return {"blue": BLUE, "green": GREEN, "vermilion": VERMILION, "window": WINDOW}
