"""A study: settings in, an outcome worked out in stages, and a folder with summary, figures, page and data of it."""

import hashlib
import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import heliograph
from heliograph.numerics.process.optional_packages import check_installed
from heliograph.report.pages.page import KeyFigures, Page, Section, Table
from heliograph.report.progress import Advance, progress
from heliograph.report.results_folder import ResultsContent, write_results
from heliograph_studies import markdown
from heliograph_studies.outcome import summary
from heliograph_studies.settings import content, differences, digest, with_values
from heliograph_studies.stages import Stages
from heliograph_studies.statement import Statement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Setting = TypeVar("Setting")
Outcome = TypeVar("Outcome")
Judged = Mapping[str, Sequence[Statement]]  # what is stated, by name of each list
WIDTH, KEYS = 80, 4  # of what is printed; key figures in it
REPEATED = ("runs", "seed")  # what tells two runs of one study apart, not two studies


def no_progress(what: str, done: int = 0, total: int = 0) -> None:
    """Of work that has not begun."""


@dataclass(frozen=True)
class Study(Generic[Setting, Outcome]):
    """A publication or an example: what it works out for a setting, and how that is shown.

    name: as the command line knows it. setting: a dataclass of numbers and of the library's objects, whose defaults are
    those of the publication. compute: from a setting to an outcome, each stage of the work through `Stages`. stages:
    how many names these have. figures: from an outcome, by name. page: a Markdown template (see `markdown`) beside the
    function `figures`. words: what the page puts in beside the outcome's fields and the constants (in capitals) of that
    function's module. publication: its title, else empty.
    statements: what is stated, by name of each list. data: writes what else belongs into the folder. needs: packages of
    extras beside those of `report`. files: what is read that no setting names; what is missing is said before any work,
    and stages that were made of other contents are made again.
    """

    name: str
    setting: type[Setting]
    compute: Callable[[Setting, Stages], Outcome]
    stages: int
    figures: "Callable[[Outcome], Mapping[str, Figure]]"
    words: Callable[[Outcome], Mapping[str, object]] = lambda _: {}
    publication: str = ""
    statements: Callable[[Outcome], Judged] = lambda _: {}
    data: Callable[[Outcome, Path], None] = lambda _, __: None
    needs: Sequence[str] = ()
    files: Callable[[Setting], Sequence[Path]] = lambda _: ()
    page: str = "page.md"

    def settings(self, values: Mapping[str, str]) -> Setting:
        """The study's own setting with other numbers, as text by dotted name.

        Raises:
            ValueError: an unknown name, text that is no value of its kind, a value out of range.
        """
        return with_values(self.setting(), values)

    def run(self, setting: Setting | None = None, out: str | Path | None = None) -> Outcome:
        """Work it out, by default for the study's own setting; with `out`, write the results to `out`/name.

        Stages that are done are kept beside that folder until it is written: a run that was stopped goes on there.

        Raises:
            ValueError: a stage that fails; a folder that cannot be written, or that holds something else.
            ModuleNotFoundError: an extra is not installed.
        """
        chosen = self.setting() if setting is None else setting
        check_installed(self.needs)
        key = self._key(chosen)  # names files that are missing
        if out is None:
            with progress(self.stages) as advance:
                stages = Stages(self.name, advance)
                with stages.failing_in_a_line():
                    return self.compute(chosen, stages)
        target, lines = Path(out) / self.name, list[str]()
        stages = Stages(self.name, no_progress, target.with_name(f"{self.name}.stages"), key)

        def work(advance: Advance) -> Outcome:
            stages.advance = advance
            return self.compute(chosen, stages)

        def results_of(outcome: Outcome) -> ResultsContent:
            stages.stage = "drawing and writing"
            return self._results(chosen, outcome, lines)

        with stages.failing_in_a_line():
            outcome = write_results(target, self.stages, work, results_of, self.needs)
        stages.clear()
        print("\n".join([*lines, f"Report: {target / 'report.html'}"]), flush=True)
        return outcome

    def _results(self, setting: Setting, outcome: Outcome, lines: list[str]) -> ResultsContent:
        """What the folder holds; its findings go to `lines`."""
        statements = self.statements(outcome)

        def page(pictures: Mapping[str, bytes]) -> Page:
            made = self.make_page(setting, outcome, statements, pictures)
            lines.extend(findings(made, statements))
            return made

        numbers = self.summary(setting, outcome, statements)
        return ResultsContent(self.figures(outcome), page, numbers, partial(self.data, outcome))

    def summary(self, setting: Setting, outcome: Outcome, statements: Judged) -> dict[str, Any]:
        """All numbers: the outcome's fields, which setting they are of, and the statements with their evidence."""
        head: dict[str, Any] = {"paper": self.publication} if self.publication else {}
        head |= {name: getattr(setting, name) for name in REPEATED if hasattr(setting, name)}
        changed = {name: {"there": there, "here": here} for name, (there, here) in self._changed(setting).items()}
        if changed:
            head["changed"] = changed
        judged = [statement.entry() for group in statements.values() for statement in group]
        return {**head, **summary(outcome), **({"claims": judged} if judged else {})}

    def command(self, setting: Setting) -> str:
        """What to type to run it again; what is no number is set in Python."""
        words = [f"heliograph {'reproduce' if self.publication else 'example'} {self.name} --out out"]
        for name in REPEATED:
            value = getattr(setting, name, None)
            if value is None or not (self.publication or value != getattr(self.setting(), name)):
                continue
            option = self.publication or name == "seed"  # examples have no --runs
            words.append(f"--{name} {value}" if option else f"--set {name}={value}")
        for name, (_, here) in self._changed(setting).items():
            words.append(f"--set {name}={here.strip('[]').replace(' ', '')}")
        return " ".join(words)

    def make_page(self, setting: Setting, outcome: Outcome, statements: Judged, pictures: Mapping[str, bytes]) -> Page:
        """The page; `pictures` holds each figure as SVG. What differs from the publication stands first."""
        template = Path(inspect.getfile(inspect.unwrap(self.figures))).with_name(self.page)
        page = markdown.page(template, self.numbers(setting, outcome), pictures, statements)
        changed = self._changed(setting)
        if not changed:
            return page
        reference = "publication" if self.publication else "example as it stands"
        caption = f"What this page says in words alone, it says of the {reference}."
        rows = [[f"`{name}`", there, here] for name, (there, here) in changed.items()]
        table = Table(["setting", "there", "here"], rows, caption)
        return replace(page, sections=[Section(f"What differs from the {reference}", [table]), *page.sections])

    def numbers(self, setting: Setting, outcome: Outcome) -> dict[str, object]:
        """What the page may put in: names in capitals of the module that draws the figures, fields, and `words`."""
        constants = {
            name: value for name, value in vars(sys.modules[self.figures.__module__]).items() if name.isupper()
        }
        example = "an example with other numbers than the paper's" if self._changed(setting) else "the paper's example"
        words = {"setting": setting, "command": self.command(setting), "the_example": example, **self.words(outcome)}
        return constants | {name: getattr(outcome, name) for name in vars(outcome)} | words

    def _changed(self, setting: Setting) -> dict[str, tuple[str, str]]:
        """Where a setting differs from the study's own, but for how many runs there are of what seed."""
        changed = differences(setting, self.setting())
        return {name: pair for name, pair in changed.items() if name not in REPEATED}

    def _key(self, setting: Setting) -> str | None:
        """What kept stages have to be of: this setting, what files hold, and the present code of study and library."""
        read, chosen = b"".join(content(path) for path in self.files(setting)), digest(setting)
        if chosen is None:
            return None
        # Of the whole package: a study may compute with what another one defines.
        root = sys.modules.get((self.compute.__module__ or "").partition(".")[0])
        file = Path(inspect.getfile(root or self.compute))
        paths = sorted(file.parent.rglob("*.py")) if hasattr(root, "__path__") else [p for p in [file] if p.is_file()]
        source = b"".join(path.read_bytes() for path in paths)
        return f"{chosen} {hashlib.sha256(read + source).hexdigest()} {heliograph.__version__}"


def findings(page: Page, statements: Judged) -> list[str]:
    """What a page says first, as lines to print: its title, key figures, and how the statements were judged."""
    blocks = [block for section in page.sections for block in section.blocks]
    keys = [key for block in blocks if isinstance(block, KeyFigures) for key in block.figures]
    lines = [page.title, *(f"- {key.label}: {key.value} ({key.note})" for key in keys[:KEYS])]
    judged = [statement for group in statements.values() for statement in group]
    if judged:
        lines.append(f"Judged by this run: {markdown.counted(judged)}.")
    return [textwrap.fill(re.sub(r"\*\*|`", "", line), WIDTH, subsequent_indent="  ") for line in lines]
