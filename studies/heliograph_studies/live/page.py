"""How the example is shown: its figure and its report."""

from collections.abc import Mapping

from matplotlib.figure import Figure

from heliograph.report.figures import BLUE, GREEN, VERMILION, Curve, paths
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.live.compute import Outcome
from heliograph_studies.live.killed import WINDOW

COMMAND = """heliograph serve heliograph_studies.live.mower:network --window 10 \\
    --store mower.sqlite --broker nats://127.0.0.1:4222/live --page 8000"""


def live_figures(outcome: Outcome) -> dict[str, Figure]:
    """The path that was told, on its map."""
    known = Curve(f"final estimates: {outcome.rmse:.2f} m off", BLUE, outcome.mean[:, :2])
    return {"map": paths(outcome.truth, [known], outcome.beacons)}


def live_page(outcome: Outcome, drawings: Mapping[str, bytes]) -> Page:
    """The report; `drawings` holds each figure as SVG."""
    same = "the same bytes" if outcome.identical else "NOT the same"
    lead = (
        f"{outcome.messages:,} messages of a drive went through a broker to a service that was killed {outcome.kills} "
        f"times with -9. Its {len(outcome.killed):,} final estimates are {same} as those of a service left alone."
    )
    return Page(
        "Heliograph example",
        f"Killed {outcome.kills} times, and every final estimate is {same}",
        lead,
        [
            _service(outcome, drawings),
            _speed(outcome),
            Section("Run it again", [Code("heliograph example live --out out")]),
        ],
    )


def _service(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    keys = [
        KeyFigure("lost", f"{outcome.lost}", "of the messages that an undisturbed service uses", VERMILION),
        KeyFigure("counted twice", f"{outcome.counted_twice}", f"{outcome.again} estimates were told again", GREEN),
        KeyFigure("position", f"{outcome.rmse:.2f} m", "root mean square error of final estimates", BLUE),
    ]
    points = [
        f"The ranges travel as packets of a radio network: {outcome.unreceived} never arrive, others late; those within "
        f"{WINDOW:g} s are put where they belong, {outcome.late} were later than that.",
        "State, sequence numbers, the late-data window and what is to be told are committed together; the broker is "
        "told after the commit, so that it sends again what a killed service had not kept.",
    ]
    shown = [f"`{name}.png`" for name in sorted(outcome.pictures)]
    text = (
        f"The live page as a browser drew it: {', '.join(shown)}." if shown else "No browser was here to draw the page."
    )
    picture = Picture(
        drawings["map"],
        "The mower's path with four beacons, and the true one.",
        "Final estimates, as the service told them.",
    )
    return Section(
        "Killed and started again",
        [KeyFigures(keys), Points(points), picture, Text([text, "The service was started so:"]), Code(COMMAND)],
    )


def _speed(outcome: Outcome) -> Section:
    names = {"jsonlines": "lines in memory, nothing kept", "mqtt": "MQTT, on disk", "nats": "NATS JetStream, on disk"}
    rows = [[names[name], f"{value:,.0f}"] for name, value in outcome.speed.items()]
    caption = "Messages of a hundred mowers on the same drive; estimates are told through the broker too."
    return Section("How fast", [Table(["from", "steps a second"], rows, caption)])
