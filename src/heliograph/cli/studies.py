"""`heliograph reproduce`, `heliograph example` and `heliograph demo`: studies, also those of other packages.

A package offers a study as an entry point of the group `heliograph.studies`, with its name and location. The entry
point is an object `publication` for `reproduce`, or an object `example` for `example`.
"""

import ast
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Protocol

from cyclopts import Parameter

from heliograph.cli.app_and_option_types import choose_results_folder, integer_option, path_option

GROUP = "heliograph.studies"
PAGES = {  # what is a page of the documentation, with blocks that run, by the name of the example that it was
    "delays": "delays.md",
    "event-triggered": "event_triggered.md",
    "fusion": "fusion.md",
    "learning": "learning.md",
    "links-with-memory": "memory.md",
    "motor-drive": "motor_drive.md",
    "network-design": "design_from_arrays.md",
    "range-bearing": "angles.md",
    "smoothing": "smoothing.md",
}
Changes = Annotated[
    list[str], Parameter(name="--set", negative="", help="Another number, as name=value; may be given several times.")
]


class Study(Protocol):
    """A study, as an entry point provides it."""

    def settings(self, values: Mapping[str, str]) -> Any:
        """Return the study's settings with other values, by name."""

    def run(self, setting: Any, out: Path) -> Any:
        """Compute the study, and write the results to its own folder in `out`."""


def demo(
    *,
    out: Annotated[Path, path_option("Folder for the estimates, figures, report and summary; made if missing.")],
    seed: Annotated[int | None, integer_option("Seed of the simulated relays; 0 unless given.")] = None,
    recording: Annotated[str | None, Parameter(help="Which drive: plaza1, or plaza2 unless given.")] = None,
    changes: Changes | None = None,
) -> None:
    """Filter a recorded radio-ranging drive whose ranges arrive through simulated relays, and report."""
    run_studies(["demo"], out, collect_changes(changes, seed=seed, recording=recording), "example")


def example(
    name: Annotated[str | None, Parameter(help="Which example; without it, the list of them.")] = None,
    /,
    *,
    out: Annotated[Path | None, path_option("Folder for the example's own, with report and summary.")] = None,
    seed: Annotated[int | None, integer_option("Seed of what is simulated; 0 unless given.")] = None,
    trace: Annotated[Path | None, path_option("Log of a radio network, for an example that takes one.")] = None,
    recording: Annotated[Path | None, path_option("Folder of a recording, for an example that takes one.")] = None,
    changes: Changes | None = None,
) -> None:
    """Run an example and report, or list them."""
    if name is None:
        return print_studies("example")
    run_studies([name], out, collect_changes(changes, seed=seed, trace=trace, recording=recording), "example")


def reproduce(
    method: Annotated[str | None, Parameter(help="Which publication, or all; without it, the list of them.")] = None,
    /,
    *,
    out: Annotated[Path | None, path_option("Folder for figures, report, record and summary.")] = None,
    runs: Annotated[int | None, integer_option("Monte Carlo runs; each publication has its own default.")] = None,
    seed: Annotated[int | None, integer_option("Seed of the simulations; 0 unless given.")] = None,
    changes: Changes | None = None,
) -> None:
    """Run a published method as printed and as improved, and judge each of its statements by this very run."""
    if method is None:
        return print_studies("publication")
    from heliograph.numerics.check import fail

    if method == "all" and changes:
        raise fail("--set", "one publication, whose settings these are", "all")
    names = list(list_studies("publication")) if method == "all" else [method]
    own_folder = "" if method == "all" else method
    run_studies(names, out, collect_changes(changes, runs=runs, seed=seed), "publication", own_folder)


def run_studies(
    names: Sequence[str], out: Path | None, values: Mapping[str, str], kind: str, own_folder: str | None = None
) -> None:
    """Run studies of a kind one after another, each into its own folder in `out`.

    A study is a module with settings, a `run` that writes its results folder, and a list of packages that it needs;
    packages offer studies as entry points (`known`).

    Args:
        names: names of the studies.
        out: the folder of the results; if it is named `own_folder` it is the study's own.
        values: settings that differ from the study's own, as texts by name.
        kind: "publication" or "example".
        own_folder: name of the study's own folder; that of the first study by default.

    Raises:
        ValueError: an unknown study or setting, a value of the wrong kind, a folder that cannot be written.
    """
    from heliograph.numerics.process.optional_packages import check_installed
    from heliograph.report.results_folder import NEEDS

    known = list_studies(kind)
    _check_names(names, known, kind)
    check_installed([package for name in names for package in (*NEEDS, *read_needed_packages(known[name].module))])
    target = choose_results_folder(
        "reproduce" if kind == "publication" else kind, out, names[0] if own_folder is None else own_folder
    )
    studies = {name: load_study(known[name]) for name in names}
    # All settings are checked before any work.
    settings = {name: change_settings(name, study, values, kind) for name, study in studies.items()}
    import jax

    for name, study in studies.items():
        study.run(settings[name], target)
        # No study uses another's compiled programs; those of all together would be gigabytes.
        jax.clear_caches()  # type: ignore[no-untyped-call]


def _check_names(names: Sequence[str], known: Mapping[str, EntryPoint], kind: str) -> None:
    """Raise ValueError for the first name that is no study of this kind, "example" or "publication".

    PAGES maps earlier examples to the pages of the documentation that replaced them.
    """
    from heliograph.numerics.check import fail

    for name in names:
        if name not in known:
            expected = ", ".join(known) + (" or all" if kind == "publication" else "")
            page = f", a page now: docs/{PAGES[name]}" if kind == "example" and name in PAGES else ""
            raise fail("method" if kind == "publication" else kind, f"one of {expected}", f"{name!r}{page}")


def change_settings(name: str, study: Study, values: Mapping[str, str], kind: str) -> Any:
    """Return a study's published settings with some of the values replaced.

    An `OptionValue` was given by an option of its own, such as --runs 10, and errors name that option. All other values
    were given by the general option for settings.

    Raises:
        ValueError: there is no such setting, or its value is wrong.
    """
    from heliograph.numerics.check import fail

    published = study.settings({})
    for option, value in values.items():
        if isinstance(value, OptionValue) and is_dataclass(published) and not hasattr(published, option):
            raise fail(f"--{option}", f"{'an' if kind == 'example' else 'a'} {kind} that takes it", repr(name))
    return study.settings(values)


class OptionValue(str):
    """A value that was given by an option of its own, not by `--set`."""

    __slots__ = ()


def collect_changes(changes: Sequence[str] | None, **options: object) -> dict[str, str]:
    """Collect values by name: of options that are set, and of each `name=value`.

    Args:
        changes: texts `name=value`, one for each --set of the command line; None without any.
        **options: the command's own options by name, such as seed and runs; None for those that are not set.

    Raises:
        ValueError: a change without a name or `=`, an invalid seed or count, a name set twice.
    """
    from heliograph.numerics.check import check_count, check_seed, fail

    values: dict[str, str] = {}
    # Options of the command, checked as numbers.
    for name, value in options.items():
        if value is not None:
            values[name] = OptionValue(value)  # marked as an option's, for errors
            if name == "seed":
                check_seed("--seed", value)
            elif name == "runs":
                check_count("--runs", value)
    # Changes by --set, each name once.
    for text in changes or ():
        name, equals, value = text.partition("=")
        if not name or not equals:
            raise fail("--set", "name=value, such as seed=1", repr(text))
        if name in values:
            raise fail("--set", f"{name} once", "twice")
        values[name] = value
    return values


def list_studies(kind: str) -> dict[str, EntryPoint]:
    """Return the studies of a kind, "publication" or "example", in installed packages, without importing them.

    Packages offer studies as entry points of GROUP. The name of the function (`attr`) is the kind.
    """
    by_name: dict[str, EntryPoint] = {}
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        first = by_name.setdefault(entry.name, entry)
        if entry.value != first.value:
            from heliograph.numerics.check import fail

            raise fail(f"study {entry.name}", "one package that offers it", f"{first.value}, {entry.value}")
    return {name: entry for name, entry in by_name.items() if entry.attr == kind}


def load_study(entry: EntryPoint) -> Study:
    """Return the study that an entry point of an installed package names; its module is imported."""
    study: Study = entry.load()
    return study


def print_studies(kind: str) -> None:
    """Print the studies of a kind, "publication" or "example", each with the first line of its module's docstring."""
    known = list_studies(kind)
    width = max(map(len, known), default=0)
    for name, entry in known.items():
        print(f"{name:{width}}  {read_first_docstring_line(entry.module)}")


def read_first_docstring_line(module: str) -> str:
    """Return the first line of a module's docstring, without running the module."""
    return (ast.get_docstring(parse_source(module)) or "").partition("\n")[0]


def read_needed_packages(module: str) -> Sequence[str]:
    """Return the packages that a study's module lists as `NEEDS`; the module is not run, since it may need them."""
    for statement in parse_source(module).body:
        match statement:
            case ast.Assign(targets=[ast.Name(id="NEEDS")], value=value):
                needs: Sequence[str] = ast.literal_eval(value)
                return needs
    return ()


def parse_source(module: str) -> ast.Module:
    """Return the syntax tree of a module's source without running it; it is empty if there is no source."""
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        return ast.Module([], [])
    return ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
