import re
from importlib.resources import files

from heliograph.report import (
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


def test_marks_are_understood_and_everything_else_is_escaped() -> None:
    html = Page("", "", "", [Section("", [Text(["a **b** `c` <d> & **e**"])])]).html()
    assert "a <strong>b</strong> <code>c</code> &lt;d&gt; &amp; <strong>e</strong>" in html


def test_every_block_reaches_the_page_escaped() -> None:
    blocks = [
        Text(["text <1>"]),
        Points(["point <2>"]),
        KeyFigures([KeyFigure("label <3>", "1 m", "note <3>", "#123456")]),
        Table(["name", "value"], [["row <4>", "7"]], "caption <4>", ["#abcdef"]),
        Table(["name", "words"], [["row <5>", "several words"]], wordy=True),
        Picture(b"<svg/>", 'seen "6"', "caption <6>"),
        Code("code <7>"),
        Statements([Judged("said <10>", "(1)", "", "so", "holds"), Judged("said <9>", "(2)", "x", "not so", "fails")]),
    ]
    html = Page("kicker", "title <0>", "lead <0>", [Section("section <0>", blocks)], "footer <8>").html()
    for expected in ("title", "lead", "section"):
        assert f"{expected} &lt;0&gt;" in html
    for number, word in enumerate(("text", "point", "note", "caption", "row", "caption", "code", "footer"), 1):
        assert f"{word} &lt;{number}&gt;" in html
    assert '<th scope="row"><span class="dot" style="--c: #abcdef"></span>row &lt;4&gt;</th><td>7</td>' in html
    assert 'src="data:image/svg+xml;base64,PHN2Zy8+"' in html
    assert "seen &#34;6&#34;" in html
    assert html.count('class="table wordy"') == 1
    assert '<li class="fails">' in html and html.index("said &lt;10&gt;") < html.index("said &lt;9&gt;")


def test_a_table_stays_a_table_on_a_phone() -> None:
    """Rows and cells keep their places: nothing in the style makes a block of a row."""
    table = Table(["filter", *("mean squared error",) * 5], [["a", *("0.0886312",) * 5]])
    html = Page("kicker", "title", "lead", [Section("part", [table])]).html()
    style = html[html.index("<style>") : html.index("</style>")]
    assert '<div class="scroll" tabindex="0">' in html and "data-header" not in html
    assert not re.search(r"\b(table|tbody|tr|th|td)[^{}]*\{[^}]*display: (block|grid|flex)", style)


def test_nothing_is_wider_than_its_window(fits, tmp_path) -> None:
    """Blocks at their worst: ten columns of numbers, long names, long words, long commands."""
    number, name = "0.0886312 ± 0.0025412", "a rather long name of a filter that somebody gave it"
    formula = "m̄ₖ₊₁=(1+β₁)(1+ε)σ²max(Φ)m̄ₖ+" * 4
    drawing = '<svg xmlns="http://www.w3.org/2000/svg" width="2000" height="100"/>'
    blocks = [
        KeyFigures([KeyFigure(name, "−1,234.567 m", "x" * 60, "#123456")] * 5),
        Table(["filter", *("mean squared error",) * 5], [[name, *(number,) * 5]] * 3, "caption " * 40),
        Table(["state", "a", "b"], [["x", "1", "2"]], "caption " * 40),
        Table(["name", "words", "more"], [["row", "several words " * 20, formula[:60]]], wordy=True),
        Statements(
            [
                Judged(formula, "Theorem 3", formula, formula, verdict)
                for verdict in ("fails", "does_not_apply", "holds_vacuously", "holds")
            ]
        ),
        Picture(drawing.encode(), "a wide picture", "caption " * 20),
        Points([formula]),
        Code("heliograph reproduce successive-relays --out out " + "--runs 20000 " * 10 + "x" * 200),
    ]
    page = tmp_path / "page.html"
    page.write_text(Page("kicker " * 10, formula, formula, [Section(formula, blocks)], formula).html())
    fits(page)


def test_template_is_part_of_the_package() -> None:
    assert files("heliograph.report.pages").joinpath("page.html.j2").is_file()
