"""The demonstration's figures and page."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import (
    BLUE,
    GREEN,
    MUTED,
    PURPLE,
    VERMILION,
    Curve,
    consistency_over_time,
    errors_with_bands,
    paths,
)
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.demo import robot
from heliograph_studies.demo.calibration import CALIBRATED, WINDOW
from heliograph_studies.demo.compute import NAMES, TABLE_HEADERS, Outcome, table_rows
from heliograph_studies.demo.learned import interval, said
from heliograph_studies.demo.scores import position_nees
from heliograph_studies.demo.twin import Design

COLOURS = dict(zip(NAMES, (BLUE, PURPLE, VERMILION, GREEN, MUTED), strict=True))
LABELS = {name: name.replace("_", " ").replace("relay aware", "relay-aware") for name in NAMES}
SHOWN = ("relay_aware", "mean_gain", "perfect_channel")
DESIGNED = {
    "as_it_is": "the range",
    "centred": "less that at the start",
    "centred_thousandth": "a thousandth of that power",
}
AVERAGED = 44  # rows, 10 s: wide enough to read, narrow enough to see when a filter goes wrong


def demo_figures(outcome: Outcome) -> dict[str, Figure]:
    """Trajectory, errors with the claimed band, and consistency over time, by file name."""
    recording, trial = outcome.recording, outcome.trials[0]
    clock, truth = recording.time - recording.start, recording.truth[:, :2]
    means = {name: np.asarray(trial.estimates[name].mean)[:, :2] for name in NAMES}
    variances = {n: np.diagonal(np.asarray(trial.estimates[n].covariance), axis1=1, axis2=2)[:, :2] for n in SHOWN}
    errors = [Curve(LABELS[n], COLOURS[n], means[n] - truth, np.sqrt(variances[n])) for n in SHOWN]
    nees = [Curve(LABELS[n], COLOURS[n], position_nees(trial.estimates[n], recording.truth)) for n in SHOWN]
    return {
        "trajectory": paths(
            truth, [Curve(_titled(outcome, n), COLOURS[n], means[n]) for n in SHOWN[:2]], recording.beacons
        ),
        "errors": errors_with_bands(clock, errors, ("x", "y")),
        "consistency": consistency_over_time(clock, nees, AVERAGED),
    }


def _titled(outcome: Outcome, name: str) -> str:
    return f"{LABELS[name]}: {outcome.trials[0].scores[name].position_rmse_m:.2f} m off"


def demo_page(outcome: Outcome, designs: Mapping[str, Design], drawings: Mapping[str, bytes]) -> Page:
    """The report; `drawings` holds each figure as SVG."""
    aware, mean = (outcome.trials[0].scores[name] for name in SHOWN[:2])
    return Page(
        kicker="Heliograph demonstration",
        title=f"Knowing the relay: {aware.position_rmse_m:.1f} m off instead of {mean.position_rmse_m:.1f} m",
        lead=(
            f"A robot mower drove {outcome.recording.odometry[:, 0].sum():.0f} m past four radio beacons. Its recorded "
            "ranges reach a remote filter through a relay that amplifies by a factor nobody knows at the time. The "
            f"filter that knows the law of that factor is off by {aware.position_rmse_m:.1f} m and says so; the one "
            f"that takes the mean factor for granted is off by {mean.position_rmse_m:.1f} m and claims "
            f"{mean.claimed_rmse_m:.1f} m."
        ),
        sections=[
            _result(outcome),
            _map(drawings),
            _honesty(drawings, outcome),
            _designed(designs),
            _origin(outcome),
            _filters(outcome),
            _constants(outcome),
            *_learned(outcome),
            _limits(outcome),
            _rerun(outcome),
        ],
        footer=(
            f"Recording: {outcome.recording.name.capitalize()}, from J. Djugash, B. Hamner and S. Roth, Navigating "
            "with ranging radios: five data sets with ground truth, Journal of Field Robotics, 2009; read from the "
            "installed gtsam package."
        ),
    )


def _result(outcome: Outcome) -> Section:
    scores, seed = outcome.trials[0].scores, outcome.trials[0].seed
    keys = [
        KeyFigure(LABELS[name], f"{scores[name].position_rmse_m:.2f} m", f"{what}; claims "
                  f"{scores[name].claimed_rmse_m:.2f} m", COLOURS[name])
        for name, what in zip(SHOWN, ("knows the law of the gains", "takes every gain as 1", "no relay, for reference"),
                              strict=True)
    ]  # fmt: skip
    caption = (
        f"Position error over {len(outcome.recording.time)} rows, relay seed {seed}; the last two columns span "
        f"{len(outcome.trials)} seeds of the relay ({seed} to {outcome.trials[-1].seed}). **RMSE**: root mean square "
        "distance from the truth. **Claimed**: the same by the filter's own covariance. **NEES / dim**: squared error "
        "in units of the claimed covariance, per dimension; 1 where it is right, above 1 is too sure, below 1 too "
        "cautious. **In 95 % ellipse**: share of rows where the truth lies inside the claimed 95 % ellipse."
    )
    rows = [[LABELS[row[0]], *row[1:]] for row in table_rows(outcome)]
    return Section(
        "The result", [KeyFigures(keys), Table(TABLE_HEADERS, rows, caption, [COLOURS[name] for name in NAMES])]
    )


def _map(drawings: Mapping[str, bytes]) -> Section:
    description = (
        "Two maps with four beacons: the relay-aware path stays near the true one, the mean-gain path scatters."
    )
    caption = "Both filters hear exactly the same relayed ranges; the number is the root mean square position error."
    return Section("On the map", [Picture(drawings["trajectory"], description, caption)])


def _honesty(drawings: Mapping[str, bytes], outcome: Outcome) -> Section:
    seconds = AVERAGED * np.mean(outcome.recording.odometry[:, 2])
    return Section(
        "Does the filter know how wrong it is?",
        [
            Picture(
                drawings["errors"],
                "Position errors in x and y of three filters over time, each with its claimed band.",
                "Error in x and in y (line) and the filter's own claim of two standard deviations (band). If the "
                "claim is right, the line stays in its band about 95 % of the time. The mean-gain band is so narrow "
                "that its line hides it.",
            ),
            Picture(
                drawings["consistency"],
                "NEES per dimension over time: mean gain far above 1, the two others around 1.",
                f"NEES per dimension, averaged over {AVERAGED} rows ({seconds:.0f} s), logarithmic. There is no "
                "confidence band: errors of neighbouring rows are correlated, so the rows are not independent samples.",
            ),
        ],
    )


def _designed(designs: Mapping[str, Design]) -> Section:
    plain, less, least = (designs[name] for name in DESIGNED)
    rows = [
        [what, f"{item.sensor:.4g}", f"{item.relay:.4g}", f"{item.rmse:.2f}", f"{item.claimed:.2f}"]
        for what, item in zip(DESIGNED.values(), (plain, less, least), strict=True)
    ]
    text = (
        "Where the robot starts is known, so that the ranges there are too. A sensor that takes them off before it "
        "sends, and a receiver that adds them back, lose nothing; but what is sent is smaller, and a gain that varies "
        f"at random multiplies only that. The same relays then need 1/{plain.power / less.power:.0f} of the power for "
        f"{less.rmse / plain.rmse:.0%} of the error, and 1/{plain.power / least.power:.0f} of it for "
        f"{least.rmse / plain.rmse:.0%}: what hurt was not too little power, but that the gains vary."
    )
    caption = (
        "Mean square of what a beacon's sensor and its relay send for a row, and the position error of the filter that "
        "knows the relays, each a mean over all seeds (the draws of the three differ)."
    )
    headers = ("what is sent", "sensor (m²)", "relay (m²)", "RMSE (m)", "claimed (m)")
    return Section("The same relays, sending less", [Text([text]), Table(headers, rows, caption)])


def _origin(outcome: Outcome) -> Section:
    recording = outcome.recording
    return Section(
        "What is recorded, what is simulated",
        [
            Points([
                f"**Recorded:** {np.count_nonzero(~np.isnan(recording.ranges))} ranges to four beacons, one beacon at "
                f"a time, {recording.time[-1] - recording.start:.0f} s; the distance travelled and the gyro's turn in "
                "between; and the true path, used for scoring, for the first pose"
                + (" and for the constants below." if _in_sample(outcome) else "; the constants below are not from "
                   "it, but for the gyro's rate at rest.")
                + (" Stretches without a range keep the rows of the odometry." if len(recording.time)
                   > np.count_nonzero(~np.isnan(recording.ranges)) else ""),
                "**Simulated:** the relay, and nothing else. Each range passes two hops; each hop multiplies by 0.8, 1 "
                "or 1.2 (probabilities 0.25, 0.5, 0.25, drawn anew for each hop and range) and adds Gaussian noise of "
                "0.1 m. A range of 50 m arrives as 32 m to 72 m, with a standard deviation of 10 m.",
            ]),
        ],
    )  # fmt: skip


def _filters(outcome: Outcome) -> Section:
    deviation = np.sqrt(outcome.extra_variance)
    return Section(
        "The filters",
        [
            Text(["All share one cubature Kalman filter, one model of the robot and one start. They differ only in "
                  "what they believe about the way from the beacon's range y to the number z that arrives:"]),
            Points([
                "**relay-aware** uses the exact mean and covariance of z = g₂(g₁ y + m) + n, with random gains g and "
                "noises m, n. The spread grows with the range, so far beacons count less.",
                "**extra noise** is the fair rival that needs no relay theory: it adds constant noise of "
                f"{outcome.extra_variance:.0f} m² ({deviation:.1f} m), the relay's variance averaged over the recorded "
                "ranges. The total is right, but near and far beacons count alike.",
                "**mean gain** is what is usually written: every gain is its mean, 1, so only the hops' noise remains.",
                "**perfect channel** hears the recorded ranges without any relay; the best that can be hoped for.",
                "**open loop** is dead reckoning from the odometry; what any use of the ranges has to beat.",
            ]),
        ],
    )  # fmt: skip


def _constants(outcome: Outcome) -> Section:
    rows = [
        [
            "gyro rate at rest",
            f"{robot.DRIVES[outcome.recording.name].gyro_rate:.3e} rad/s",
            "mean reading before the first movement, without the truth",
        ],
        ["range scale", f"{robot.RANGE_SCALE:.4f}", "ranges on true distances, regression through the origin"],
        ["range variance", f"{robot.RANGE_VARIANCE:.4f} m²", "mean squared residual of that regression"],
        ["position walk", f"{robot.POSITION_WALK:.2e} m²/m", "odometry along the true headings against the truth"],
        ["heading walk", f"{robot.HEADING_WALK:.2e} rad²/s", "gyro less its rate at rest, against the true turn"],
    ]
    whence = "" if _in_sample(outcome) else "All but the gyro's rate are measured on another drive, Plaza2. "
    text = (
        f"{whence}Both walks match the mean square drift over windows of {WINDOW} rows (22.6 s): the odometry's "
        "errors are correlated over seconds, and single rows would understate them."
    )
    return Section(
        "How the constants were measured", [Table(["constant", "value", "how"], rows, wordy=True), Text([text])]
    )


def _learned(outcome: Outcome) -> list[Section]:
    result = outcome.learned
    if result is None:
        return []
    calibrated = robot.Constants(robot.DRIVES[outcome.recording.name].gyro_rate)._asdict()
    rows = [
        [row.name.replace("_", " "), f"{calibrated[row.name]:.4g}", f"{row.estimate:.4g}", interval(row)]
        for row in result.result.rows()
    ]
    caption = (
        "Each constant as it was measured with the truth (the gyro's rate: at rest), and as the likelihood of the "
        "ranges alone finds it, with its 95 % interval."
    )
    after, before = (item.position_rmse_m for item in (result.second_half, result.second_half_calibrated))
    return [Section("What the ranges alone say", [
        Text([
            f"The same constants can be learned without the truth, by `hg.fit`: here from the first {result.rows} rows. "
            "The filter with the learned constants hears the ranges without a relay, and is judged on the second half "
            f"of the drive: it is off by **{after:.3f} m** where the calibrated one is off by {before:.3f} m.",
            said(result),
        ]),
        Table(["constant", "calibrated", "learned", "95 %"], rows, caption),
    ])]  # fmt: skip


def _in_sample(outcome: Outcome) -> bool:
    """Whether the drive that is scored is the one that the constants were measured on."""
    return outcome.recording.name == CALIBRATED


def _limits(outcome: Outcome) -> Section:
    local, always = [], [
        "One drive, one map. The spread over seeds is that of the simulated relay alone, not of other drives.",
        "A cubature covariance is an approximation, not a bound; NEES near 1 is found here, not guaranteed.",
    ]  # fmt: skip
    if _in_sample(outcome):
        local = [
                "The five constants come from the recording that is scored (in-sample). They describe the robot and "
                "its radios, not the relay, and all filters share them.",
                "The recorded odometry distance agrees with the true path almost exactly, so dead reckoning "
                "drifts mostly through its heading. Another robot's odometry may be worse.",
                "The gyro's scale is off by about 1.5 %. It is left uncalibrated and covered by the heading walk, "
                "whose size therefore depends on the window.",
                "In the last 3 s the mower backs up by half a metre. The recorded distance has no sign, so every "
                "filter takes it for forward motion: hence the rise at the end of the perfect channel's NEES.",
        ]  # fmt: skip
    else:
        local = [
            "The constants come from another drive; only the gyro's rate at rest, the places of the beacons and the "
            "first pose are this drive's.",
            "The recorded turns add up to the true ones almost exactly, as no gyro's do: they seem to have been "
            "corrected before they were published. Dead reckoning alone is better here than the filter that trusts "
            "the mean gain.",
            "Twice the file goes back by about a minute. The ranges fit the truth where their time stamps say, so they "
            "are used in that order.",
        ]  # fmt: skip
    return Section("What to keep in mind", [Points([*local, *always])])


def _rerun(outcome: Outcome) -> Section:
    seed, name = outcome.trials[0].seed, outcome.recording.name
    option, place = ("", "") if _in_sample(outcome) else (f" --recording {name}", f":{name}")
    commands = (
        f"heliograph demo --out out --seed {seed}{option}\n\n"
        "# the same filters on the relayed ranges, as you would run your own network\n"
        f"heliograph run heliograph_studies.demo.robot{place} \\\n"
        "    --measurements out/demo/measurements.csv --out estimates.csv"
    )
    text = (
        "Beside this page: `summary.json` (every number of the table, for all seeds), `estimates.parquet`, "
        "`measurements.csv` (odometry and relayed ranges) and the figures."
    )
    return Section("Run it again", [Code(commands), Text([text])])
