"""Write the figures of results.json and soak.json where README.md and docs/ state them.

Run: python benchmarks/pages.py, after benchmarks/run.py with all peers, or after benchmarks/soak.py. A place is a
sentence that stands once in its page, with {} for each figure. tests/test_docs.py compares the pages with what this
would write.
"""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
RESULTS, SOAK = ROOT / "benchmarks" / "results.json", ROOT / "benchmarks" / "soak.json"
FIGURE = r"\d[\d,.]*(?<![,.])"
TABLE = re.compile(r"(\| problem \| ours \|.*\n\|-.*\n)(?:\|.*\n)+")


class Place(NamedTuple):
    """A sentence with {} for each figure, and the figures as they are printed."""

    sentence: str
    figures: tuple[str, ...]


def digits(value: float) -> str:
    """Three digits at least, as in the table."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}"


def whole(*values: float) -> tuple[str, ...]:
    return tuple(f"{value:,.0f}" for value in values)


def readme(measured: dict[str, Any]) -> list[Place]:
    """The table beside the best peers."""
    results = {
        name: (item["ours"]["best"], {title: peer["best"] for title, peer in item["peers"].items()})
        for name, item in measured["comparisons"].items()
    }
    kalman, cubature, modes, smoothing = (results[name] for name in ("kalman", "cubature", "modes", "smoothing"))
    design = measured["alone"]["network_design"]["values"]["two hops, 20 sensors, 30 starts"] / 1000
    return [
        Place("with a bound on what is missing | no package has it | {} s |", (f"{design:.2f}",)),
        Place(
            "| a Kalman step with a gain of its own in each run | cuthbert {} ns; FilterPy {} ns | {} ns |",
            whole(kalman[1]["cuthbert, vectorised"], kalman[1]["FilterPy, a loop"], kalman[0]),
        ),
        Place(
            "| a cubature step behind relays | `jax.numpy.linalg` {} ns; FilterPy {} ns | {} ns |",
            whole(cubature[1]["jax.numpy.linalg, vectorised"], cubature[1]["FilterPy, mean gain only"], cubature[0]),
        ),
        Place(
            "| a step of multiple models (IMM), two modes | FilterPy {} ns | {} ns |",
            whole(modes[1]["FilterPy, a loop"], modes[0]),
        ),
        Place(
            "| a step of smoothing, gains as above | cuthbert {} ns; pykalman {} ns | {} ns |",
            whole(smoothing[1]["cuthbert, vectorised"], smoothing[1]["pykalman, a loop"], smoothing[0]),
        ),
    ]


def comparisons(measured: dict[str, Any]) -> list[Place]:
    """What stands around the table of docs/comparisons.md."""
    machine, startup, stream = measured["machine"], *(measured["alone"][n]["values"] for n in ("startup", "stream"))
    filterpy = measured["comparisons"]["kalman"]["peers"]["FilterPy, a loop"]["best"] / 1000
    first, again = (startup[f"linear filter, {which}"] for which in ("first process", "again"))
    python = ".".join(machine["python"].split(".")[:2])
    return [
        Place(f"({machine['cpu']}, {{}} cores, Python {{}})", (str(machine["cores"]), python)),
        Place(
            "a step of `hg.Stream` takes {} µs in the median, one of FilterPy {} µs",
            whole(stream["one sample, median"], filterpy),
        ),
        Place("{} s for the first linear filter of a process", (f"{first:.1f}",)),
        Place("{} s with compiled programs kept on disk", (f"{again:.1f}",)),
    ]


def learning(measured: dict[str, Any]) -> dict[str, list[Place]]:
    """Of a fit beside its peers, if it was measured beside them."""
    if "learning" not in measured["alone"]:
        return {"README.md": [], "docs/comparisons.md": []}
    took = measured["alone"]["learning"]["values"]
    alone, ours, statsmodels, kalman_py = (
        f"{took[name]:.3f}" for name in ("heliograph, maximum alone", "heliograph", "statsmodels", "kalman-py")
    )
    pykalman, below = (f"{took[name]:.1f}" for name in ("pykalman", "nats below, pykalman"))
    return {
        "README.md": [
            Place(
                "| two noise variances learned from 10,000 steps | statsmodels {} s | {} s; {} s with intervals |",
                (statsmodels, alone, ours),
            )
        ],
        "docs/comparisons.md": [
            Place("`hg.fit` takes {} s, with its intervals {} s", (alone, ours)),
            Place("statsmodels' maximum likelihood {} s", (statsmodels,)),
            Place("kalman-py's `fit_noise`, which compiles anew at each call, {} s", (kalman_py,)),
            Place("ten iterations of pykalman's EM {} s, after which", (pykalman,)),
            Place("its log-likelihood is still {} below the maximum", (below,)),
        ],
    }


def claims(soaked: dict[str, Any]) -> list[Place]:
    """What the random networks said of the claims."""
    said = whole(soaked["networks"], soaked["comparisons"])
    return [
        Place("`make soak` draws {} random networks", said[:1]),
        Place("{} comparisons of a simulated with a claimed variance", said[1:]),
        Place("more than {} standard errors", (f"{soaked['limit in standard errors']:.1f}",)),
        Place("{} of the networks are computed again in other units", whole(soaked["rescaled"])),
        Place("In {} networks a filter flagged its own result", whole(soaked["networks with flagged failures"])),
    ]


def places(measured: dict[str, Any]) -> dict[str, list[Place]]:
    """Every place by page."""
    gradient = measured["alone"]["network_design"]["values"]["error and gradient, 6 sensors"]
    learned, robust = learning(measured), measured["alone"]["robust"]
    weighed = [robust["values"][name] for name in robust["at_most"]]
    others = ("Student, variational Bayes", "contaminated, score", "Student, score", "adaptive")
    doubted = [robust["values"][f"two outputs: {name} over plain"] for name in others]
    return {
        "README.md": readme(measured) + learned["README.md"],
        "docs/comparisons.md": comparisons(measured) + learned["docs/comparisons.md"],
        "docs/network_design.md": [Place("three states and twelve hops take {} ms", (f"{gradient:.1f}",))],
        "docs/robust.md": [
            Place("take {} to {} times as long, with", (f"{min(weighed):.2f}", f"{max(weighed):.2f}")),
            Place(
                "Bayes\ntakes {}, the score of a contaminated law {}, that of Student's law, a mixture of 25, {}, "
                "and the adaptive filter {} times\n",
                tuple(f"{value:.1f}" for value in doubted),
            ),
        ],
        "docs/theory.md": claims(json.loads(SOAK.read_text(encoding="utf-8"))),
    }


def rows(measured: dict[str, Any]) -> str:
    """The table of docs/comparisons.md: a row for each peer."""
    return "".join(
        f"| {item['title']} | {digits(item['ours']['best'])} | {title} ({peer['how']}) "
        f"| {digits(peer['best'])} | {digits(peer['ratio'])} |\n"
        for item in measured["comparisons"].values()
        for title, peer in item["peers"].items()
    )


def with_figures(text: str, place: Place) -> str:
    """A page with the figures of one place.

    Raises:
        ValueError: the sentence does not stand there once.
    """
    pattern = FIGURE.join(map(re.escape, place.sentence.split("{}")))
    result, times = re.subn(pattern, lambda _: place.sentence.format(*place.figures), text)
    if times != 1:
        raise ValueError(f"expected once in the page, got {times} times: {place.sentence}")
    return result


def written(measured: dict[str, Any]) -> dict[str, str]:
    """All pages as they should be, by their path from the root."""
    absent = [title for item in measured["comparisons"].values() for title, p in item["peers"].items() if "absent" in p]
    if absent:
        raise ValueError(f"results.json: expected every peer, got none of {', '.join(absent)}")
    pages = {}
    for page, here in places(measured).items():
        text = (ROOT / page).read_text(encoding="utf-8")
        for place in here:
            text = with_figures(text, place)
        pages[page] = text
    pages["docs/comparisons.md"] = TABLE.sub(lambda result: result[1] + rows(measured), pages["docs/comparisons.md"])
    return pages


if __name__ == "__main__":
    for page, text in written(json.loads(RESULTS.read_text(encoding="utf-8"))).items():
        (ROOT / page).write_text(text, encoding="utf-8")
