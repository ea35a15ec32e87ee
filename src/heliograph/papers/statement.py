"""One statement of a publication, judged."""

from typing import Literal, NamedTuple

import numpy as np

Verdict = Literal["holds", "holds_vacuously", "fails"]


class Statement(NamedTuple):
    """What a publication states, where, what it says there in numbers, what is found here, and the verdict.

    "holds_vacuously": true, but so it would be without any measurement, or its premise is never met.
    """

    text: str
    source: str
    paper: str
    ours: str
    verdict: Verdict

    def entry(self) -> dict[str, str]:
        """As it stands in a summary, which calls a statement a claim."""
        return {"claim": self.text, **{name: value for name, value in self._asdict().items() if name != "text"}}


def holds(condition: bool | np.bool | None) -> Verdict:
    """ "holds" or "fails" (also where nothing could be judged, None)."""
    return "holds" if condition else "fails"


def if_met(premise: bool) -> Verdict:
    """ "holds" for a theorem whose premise is met here, else "holds_vacuously"."""
    return "holds" if premise else "holds_vacuously"
