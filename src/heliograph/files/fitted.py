"""Files of a fit: `fitted.json`, and next to it a Python file that loads the network with the fitted numbers."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from heliograph.files.network_file import load_network
from heliograph.learning.fit_result import Fit
from heliograph.learning.packet_losses.delay_law import Delays
from heliograph.learning.parametric_network import describe
from heliograph.numerics.check import fail, file_path
from heliograph.simulation.network import Network

FITTED = "fitted.json"
NETWORK = "fitted_network.py"

SOURCE = '''"""{network} with the numbers learned from {measurements}, which stand in {fitted}.

    heliograph run {file} --measurements data.csv --report report
"""

from pathlib import Path

import heliograph as hg

HERE = Path(__file__).parent
network = hg.files.load_fitted({reference}, HERE / "{fitted}")
'''


@dataclass(frozen=True)
class NetworkAgain:
    """Builds the network of a file or module anew at each call, so that `hg.free` is called again.

    A file is run again; of an installed module a function that returns the network is called again.
    """

    reference: str

    def __call__(self) -> Network:
        """Load the network."""
        return load_network(self.reference)


def as_json(fitted: Fit, **more: Any) -> dict[str, Any]:
    """Return a fit as JSON: values by name, their table, sentences about them, and how the search went.

    NaN becomes null. "ends" holds the log-likelihood that each start of the search reached. `more` holds entries that
    are put before these.
    """
    return {
        **more,
        "values": {name: np.asarray(value).tolist() for name, value in fitted.values.items()},
        "table": [{key: _replace_non_finite(value) for key, value in row._asdict().items()} for row in fitted.table],
        "delays": {node: _tabulate_delays(delays) for node, delays in fitted.delays.items()},
        "sentences": list(fitted.sentences),
        "log_likelihood": dict(fitted.log_likelihoods),
        "ends": [_replace_non_finite(float(end)) for end in fitted.ends],
        "converged": fitted.converged,
        "stopped": fitted.stopped,
    }


def write_fitted(content: Mapping[str, object], reference: str, measurements: str, folder: Path, target: Path) -> None:
    """Write `fitted.json`, and `fitted_network.py`, which loads the network with the numbers in `fitted.json`.

    Args:
        content: the content of `fitted.json`.
        reference: the network, as FILE:NAME or MODULE:NAME.
        measurements: name of the file that was learned from.
        folder: the folder where both files are written.
        target: the folder's later name. The path to the network's file is relative to it.
    """
    (folder / FITTED).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    path, colon, name = _split_reference(reference)  # path is None for MODULE:NAME
    if path is None:
        source = repr(reference)
    else:
        relative = Path(os.path.relpath(path.resolve(), target.resolve())).as_posix()
        source = f"str(HERE / {relative + colon + name!r})"  # quoted, whatever characters the path has
    named = {"network": _quote_in_docstring(reference), "measurements": _quote_in_docstring(measurements)}
    # The template of a Python file that loads the network and puts the fitted numbers in.
    text = SOURCE.format(**named, fitted=FITTED, file=NETWORK, reference=source)
    (folder / NETWORK).write_text(text, encoding="utf-8")


def load_fitted(reference: str | Path, fitted: str | Path) -> Network:
    """Load the network of a file or module, with the fitted numbers in place of those that `hg.free` marks.

    Args:
        reference: path of the file or name of the module, as for `load_network`.
        fitted: path of the `fitted.json` of a fit.

    Raises:
        ValueError: what `load_network` refuses; a file that is no result of a fit of this network.
    """
    file_path("network", reference)  # checked alone: the name of a module is no path
    path = file_path("fitted numbers", fitted)
    # The network as a function of its free numbers: it is built anew for each call, so that `hg.free` takes them.
    network_of_numbers = describe(NetworkAgain(str(reference)))
    try:
        values = json.loads(path.read_text(encoding="utf-8"))["values"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise fail(f"fitted numbers {path}", "a file that `heliograph fit` wrote", type(error).__name__) from None
    free_shapes = {parameter.name: parameter.start.shape for parameter in network_of_numbers.parameters.every}
    if {name: np.shape(value) for name, value in values.items()} != free_shapes:
        raise fail(f"fitted numbers {path}", f"those that are free in the network, {list(free_shapes)}", list(values))
    numbers = {name: np.asarray(value) if np.ndim(value) else float(value) for name, value in values.items()}
    return network_of_numbers.at(numbers)


def _tabulate_delays(delays: Delays) -> dict[str, Any]:
    """Return the estimated distribution of a node's delays as JSON has it.

    It has the length of a step, how many messages were counted and how many of them came early, and for each delay in
    steps its share with an interval.
    """
    shares = [{"steps": steps, **share._asdict()} for steps, share in delays.shares.items()]
    return {"step": delays.step, "counted": delays.counted, "early": delays.early, "shares": shares}


def _replace_non_finite(value: object) -> object:
    """Return a value for JSON: None in place of a float that is not finite."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _split_reference(reference: str) -> tuple[Path | None, str, str]:
    """Return the path, the colon and the name of a reference FILE:NAME or MODULE:NAME.

    The path is None for a module. Without a name, colon and name are "".
    """
    module, colon, name = reference.rpartition(":")
    if not module or not name.isidentifier():
        module, colon, name = reference, "", ""
    is_file = module.endswith(".py") or os.sep in module or Path(module).is_file()
    return (Path(module) if is_file else None), colon, name


def _quote_in_docstring(text: str) -> str:
    """Return a file's name without the characters that would end or escape in the docstring of a Python file."""
    return Path(text).name.replace("\\", "/").replace('"', "'")
