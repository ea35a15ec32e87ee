"""The built site (`make docs` runs this after building): links lead somewhere, pages need nothing from outside.

HELIOGRAPH_PICTURES=FOLDER keeps each page as a picture at both widths.
"""

import inspect
import os
import re
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from urllib.parse import unquote, urldefrag

import pytest
from chromium import Browser, program

import heliograph

SITE = Path(__file__).parents[2] / "out" / "docs"
PAGES = sorted(path.relative_to(SITE).as_posix() for path in SITE.rglob("*.html") if "_static" not in path.parts)
QUESTIONS = ["which_filter.html", "theory.html", "extend.html", "errata.html", "comparisons.html"]  # of a newcomer
WORDS = ["UKF", "RTS", "NIS", "batch", "gating", "multi-rate", "missing", "late", "dropout"]  # typed into the search
LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}
NOT_LOADED = {"canonical", "index", "search", "next", "prev", "author", "copyright"}


class Links(HTMLParser):
    """Where a page leads, what it loads, and the places in it that can be led to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.leads: set[str] = set()
        self.loads: set[str] = set()
        self.places: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        result = dict(attributes)
        self.places |= {name for key in ("id", "name") if (name := result.get(key))}
        if tag == "a" and result.get("href"):
            self.leads.add(result["href"])
        if tag in LOADED and result.get(LOADED[tag]) and result.get("rel") not in NOT_LOADED:
            self.loads.add(result[LOADED[tag]])


@cache
def links(page: str) -> Links:
    return Links((SITE / page).read_text())


def outside(address: str) -> bool:
    return address.startswith(("http:", "https:", "//"))


def test_the_site_is_there():
    assert {"index.html", *QUESTIONS} <= set(PAGES), "build the site first: make docs"


def test_the_reference_has_every_public_name():
    anchors = set().union(*(links(page).places for page in PAGES if page.startswith("_made/api/")))
    public = {f"heliograph.{n}" for n in heliograph.__all__ if not inspect.ismodule(getattr(heliograph, n))}
    rooms = [stub.parent.name for stub in Path(heliograph.__file__).parent.glob("*/__init__.pyi")]
    public |= {f"heliograph.{room}.{name}" for room in rooms for name in import_module(f"heliograph.{room}").__all__}
    assert len(public) > 150 and "heliograph.serving.Service" in public
    assert sorted(public - anchors) == []


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    result = links(page)
    assert not [address for address in result.loads if outside(address)]
    for address in {
        a for a in result.leads | result.loads if not outside(a) and not a.startswith(("mailto:", "data:"))
    }:
        where, place = urldefrag(unquote(address))
        target = ((SITE / page).parent / where.partition("?")[0]).resolve() if where else SITE / page
        assert target.exists(), address
        if place and target.suffix == ".html":
            assert place in links(target.relative_to(SITE).as_posix()).places, address


@pytest.mark.parametrize("page", QUESTIONS)
def test_an_answer_is_two_clicks_from_the_start(page):
    item = {urldefrag(a)[0] for a in links("index.html").leads if not outside(a)} & set(PAGES)
    two = {urldefrag(a)[0] for first in item if "/" not in first for a in links(first).leads}
    assert page in item | two


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if program() is None:
        pytest.skip("no Chromium here")
    with Browser() as outcome:
        yield outcome


@pytest.mark.parametrize("width", [1200, 420])
@pytest.mark.parametrize("page", PAGES)
def test_a_page_loads_without_a_complaint(browser, page, width):
    """From disk, without a server: nothing asked for elsewhere, nothing wrong, and no scrolling sideways."""
    seen = browser.open((SITE / page).as_uri(), width)
    if pictures := os.environ.get("HELIOGRAPH_PICTURES"):
        Path(pictures).mkdir(parents=True, exist_ok=True)
        browser.picture(Path(pictures) / f"{page.replace('/', '-')}-{width}.png")
    assert [a for a in seen.requests if not a.startswith(("file:", "data:", "blob:"))] == []
    assert seen.errors == []
    assert seen.width <= width


@pytest.mark.parametrize("word", WORDS)
def test_the_search_leads_from_a_word_of_other_packages_to_a_page_that_has_it(browser, word):
    browser.open(f"{(SITE / 'search.html').as_uri()}?q={word}")
    finished = "document.querySelector('.search-summary')?.textContent.startsWith('Search finished')"
    wait = f"new Promise(done => {{ const id = setInterval(() => {finished} && (clearInterval(id), done(0)), 50) }})"
    browser.call("Runtime.evaluate", expression=wait, awaitPromise=True)
    pages = "[...document.querySelectorAll('#search-results li a')].map(a => a.getAttribute('href')).join(' ')"
    addresses = browser.call("Runtime.evaluate", expression=pages)["result"]["value"]
    assert "coming_from.html" in addresses or "irregular.html" in addresses


@pytest.mark.parametrize("word", WORDS)
def test_the_index_has_a_word_of_other_packages(word):
    leads = re.findall(r'<a href="(index\.html#words-\d+)">([^<]*)</a>', (SITE / "genindex.html").read_text())
    targets = {address for address, text in leads if word in re.split(r"\W+", text) or word == text.split()[0]}
    assert targets and all(urldefrag(address).fragment in links("index.html").places for address in targets)
