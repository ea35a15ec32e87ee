"""A page written in Markdown, with numbers put in: a Jinja template whose result is read as sections and blocks.

A paragraph before the title is what stands above it, one after it the lead, what follows a rule (---) the last line.
A title with two signs begins a section. Beside paragraphs, points, code and tables there are

    ![what is seen](fig1)                a figure by name

    : What it shows.                     the caption of the table or figure before it

    ```keys                              numbers to remember: colour, label, value, note
    #0072b2 | quadratic | 50.5 % | less error variance
    ```

    ```statements                        statements by name, how many of them fail, and each with its verdict
    theorems
    ```

A cell that begins with a colour gets a dot of it; a table whose second column is set to the left (:--) holds words.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, TemplateError
from markdown_it import MarkdownIt
from markdown_it.tree import SyntaxTreeNode

from heliograph.numerics.check import fail
from heliograph.report.pages.page import (
    Block,
    Code,
    Judged,
    KeyFigure,
    KeyFigures,
    Page,
    Picture,
    Points,
    Section,
    Statements,
    Table,
    Text,
)
from heliograph_studies.statement import Rule, Sampled, Statement, Verdict

SAID: Mapping[Verdict, tuple[str, str]] = {
    "fails": ("fails", "fail"),
    "does_not_apply": ("does not apply here", "do not apply here"),
    "holds_vacuously": ("is true but empty", "are true but empty"),
    "holds": ("holds", "hold"),
}
EMPTY = "**True but empty**: it would be so without any measurement."
PICTURE = re.compile(r"!\[(.*)\]\((\w+)\)", re.DOTALL)
EVIDENCE = re.compile(r"([\w.]+) = (.*)")
COLOURED = re.compile(r"(#[0-9a-f]{6})\s+(.*)", re.DOTALL)


def page(
    template: Path,
    numbers: Mapping[str, object],
    pictures: Mapping[str, bytes],
    statements: Mapping[str, Sequence[Statement]],
) -> Page:
    """The page of a template; `pictures` holds each figure as SVG.

    Raises:
        ValueError: a template that puts in what is not there, or a part of it that cannot be read.
    """
    tree = SyntaxTreeNode(MarkdownIt("commonmark").enable("table").parse(filled(template, numbers)))
    title, footer = "", ""
    head: list[str] = []
    lead: list[str] = []
    sections: list[tuple[str, list[Block]]] = []
    for node in tree.children:
        if node.type == "heading" and node.tag == "h1":
            title, head, lead = _text(node), lead, []
        elif node.type == "heading":
            sections.append((_text(node), []))
        elif node.type == "hr":
            footer = _text(tree.children[-1])
            break
        elif not sections:
            lead.append(_text(node))
        else:
            _add(sections[-1][1], node, pictures, statements)
    return Page(" ".join(head), title, " ".join(lead), [Section(*section) for section in sections], footer)


def filled(template: Path, numbers: Mapping[str, object]) -> str:
    """The template's text with numbers put in; `fmt` writes one as Python's format does, `pm` one with its error.

    Raises:
        ValueError: a template that puts in what is not there.
    """
    try:
        return _environment(template.parent).get_template(template.name).render(numbers)
    except TemplateError as error:
        raise fail(f"page {template}", "a template of what was found", error) from error


@cache
def _environment(folder: Path) -> Environment:
    """The templates of a folder, each compiled once."""
    environment = Environment(
        loader=FileSystemLoader(folder), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"fmt": format, "pm": with_error}
    return environment


def with_error(pair: tuple[float, float], digits: str = "") -> str:
    """A number and its standard error, both as Python's format writes them; every digit by default."""
    return f"{pair[0]:{digits}} ± {pair[1]:{digits}}"


def stated(study: str, numbers: Mapping[str, object]) -> dict[str, list[Statement]]:
    """The statements in `statements.md` beside a study's file, by the headings of the first level.

    A heading of the second level is what is stated. Under it stand `where | what is printed there`, what is found, and
    a block `judged`: a line `name = number` for each piece of evidence, and the rule of the verdict.

    Raises:
        ValueError: a template that puts in what is not there, or a rule that asks for what is no evidence.
    """
    result: dict[str, list[Statement]] = {}
    for part in re.split(r"^(?=##? )", filled(Path(study).with_name("statements.md"), numbers), flags=re.MULTILINE)[1:]:
        level, _, rest = part.partition(" ")
        text, _, body = rest.partition("\n")
        if level == "#":
            result[text] = group = []
            continue
        said, _, block = body.partition("```judged\n")
        place, _, ours = said.strip().partition("\n")
        source, _, paper = place.partition("|")
        lines = [EVIDENCE.fullmatch(line) or line for line in block.strip().removesuffix("```").splitlines()]
        evidence = {line[1]: number(line[2]) for line in lines if not isinstance(line, str)}
        rule = Rule(" ".join(line.strip() for line in lines if isinstance(line, str)).strip())
        if not rule.names <= {*evidence, "evidence"}:
            raise fail(f"verdict on {text!r}", f"one that follows from {', '.join(evidence)}", repr(rule.text))
        group.append(Statement(text, source.strip(), paper.strip(), " ".join(ours.split()), evidence, rule))
    return result


def number(text: str) -> float | Sampled:
    """Evidence as it is written: a number, or one with its standard error."""
    value, _, error = text.partition(" ± ")
    if error:
        return Sampled(float(value), float(error))
    return int(text) if re.fullmatch(r"-?\d+", text) else float(text)


def _add(
    blocks: list[Block],
    node: SyntaxTreeNode,
    pictures: Mapping[str, bytes],
    statements: Mapping[str, Sequence[Statement]],
) -> None:
    """Add what a node says, or give it as the caption to the table or figure before it."""
    if node.type == "bullet_list":
        blocks.append(Points([_text(child.children[0]) for child in node.children]))
    elif node.type == "table":
        blocks.append(_table(node))
    elif node.type == "fence" and node.info == "keys":
        rows = [[part.strip() for part in line.split("|")] for line in node.content.splitlines()]
        blocks.append(KeyFigures([KeyFigure(label, value, note, colour) for colour, label, value, note in rows]))
    elif node.type == "fence" and node.info == "statements":
        blocks += verdicts([statement for name in node.content.split() for statement in statements[name]])
    elif node.type == "fence":
        blocks.append(Code(node.content.rstrip("\n")))
    elif picture := PICTURE.fullmatch(_text(node)):
        blocks.append(Picture(pictures[picture[2]], picture[1]))
    elif _text(node).startswith(": ") and blocks and isinstance(blocks[-1], Table | Picture):
        blocks[-1] = replace(blocks[-1], caption=_text(node)[2:])
    else:
        blocks.append(Text([_text(node)]))


def _text(node: SyntaxTreeNode) -> str:
    """What is written in a paragraph, heading or cell, in one line."""
    return " ".join(child.content for child in node.children).replace("\n", " ").strip()


def _table(node: SyntaxTreeNode) -> Table:
    header, *rows = (row for child in node.children for row in child.children)
    cells = [[_text(cell) for cell in row.children] for row in rows]
    wordy = "left" in str(header.children[1].attrs.get("style", ""))
    colours = [COLOURED.fullmatch(row[0]) for row in cells]
    named = [[colour[2] if colour else row[0], *row[1:]] for row, colour in zip(cells, colours, strict=True)]
    dots = [colour[1] for colour in colours if colour]
    return Table([_text(cell) for cell in header.children], named, colours=dots or None, wordy=wordy)


def verdicts(statements: Sequence[Statement]) -> list[Block]:
    """How many there are of each verdict, and all of them, in the order of the publication."""
    text = f"Judged by the numbers of this very run: {counted(statements, '**')}."
    empty = any(statement.verdict == "holds_vacuously" for statement in statements)
    judged = [
        Judged(statement.text, statement.source, statement.paper, statement.ours, statement.verdict)
        for statement in statements
    ]
    return [Text([f"{text} {EMPTY}" if empty else text]), Statements(judged)]


def counted(statements: Sequence[Statement], strong: str = "") -> str:
    """How many statements the publication makes, by verdict; how many are added here, and how many of those hold."""
    papers = [statement for statement in statements if statement.in_paper]
    count = Counter(statement.verdict for statement in papers)
    parts = [f"{count[verdict]} {words[count[verdict] > 1]}" for verdict, words in SAID.items() if count[verdict]]
    noun = "statement" if len(papers) == 1 else "statements"
    text = f"of {len(papers)} {noun} of the paper {strong}{', '.join(parts)}{strong}"
    ours = [statement for statement in statements if not statement.in_paper]
    if not ours:
        return text
    true = sum(statement.verdict == "holds" for statement in ours)
    added = f"of {len(ours)} that the paper does not make and are tried here, {true} hold{'s' if true == 1 else ''}"
    return f"{text}; {added}" if papers else added
