from importlib.resources import files

from heliograph.report.page import (
    Code,
    KeyFigure,
    KeyFigures,
    Page,
    Picture,
    Points,
    Section,
    Table,
    Text,
    rich,
)


def test_marks_are_understood_and_everything_else_is_escaped() -> None:
    assert rich("a **b** `c` <d> & **e**") == ("a <strong>b</strong> <code>c</code> &lt;d&gt; &amp; <strong>e</strong>")


def test_every_block_reaches_the_page_escaped() -> None:
    blocks = [
        Text(["text <1>"]),
        Points(["point <2>"]),
        KeyFigures([KeyFigure("label <3>", "1 m", "note <3>", "#123456")]),
        Table(["name", "value"], [["row <4>", "7"]], "caption <4>", ["#abcdef"]),
        Table(["name", "words"], [["row <5>", "several words"]], wordy=True),
        Picture(b"<svg/>", 'seen "6"', "caption <6>"),
        Code("code <7>"),
    ]
    html = Page("kicker", "title <0>", "lead <0>", [Section("section <0>", blocks)], "footer <8>").html()
    for expected in ("title", "lead", "section"):
        assert f"{expected} &lt;0&gt;" in html
    for number, word in enumerate(("text", "point", "note", "caption", "row", "caption", "code", "footer"), 1):
        assert f"{word} &lt;{number}&gt;" in html
    assert '<th scope="row"><span class="dot" style="--c: #abcdef"></span>row &lt;4&gt;</th><td>7</td>' in html
    assert 'src="data:image/svg+xml;base64,PHN2Zy8+"' in html
    assert "seen &#34;6&#34;" in html
    assert html.count('class="wordy"') == 1


def test_template_is_part_of_the_package() -> None:
    assert files("heliograph.report").joinpath("page.html.j2").is_file()
