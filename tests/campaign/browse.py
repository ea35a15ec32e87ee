"""Opens a page to explore in a browser and chooses: it must draw that, ask for nothing and never complain."""

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "_site"))
from chromium import Browser

TITLES = "[...document.querySelectorAll('#panels h3')].map(title => title.textContent)"
ROWS = "document.querySelectorAll('#cells tr').length"
DRAWN = """(async () => {
    while (document.documentElement.dataset.drawn !== '%d') await new Promise(next => setTimeout(next, 20));
    return document.querySelectorAll('#panels .plot > *').length;
})()"""
CHOOSE = """(() => {
    const choice = document.getElementById('%s');
    choice.value = '%s';
    choice.dispatchEvent(new Event('change'));
})()"""
DOT = """(() => {  // where the first dot of the second panel is
    const view = [...Bokeh.index.roots][1], plot = view.canvas.el.getBoundingClientRect();
    const {x, y} = view.model.renderers.at(-1).data_source.data;
    return [plot.x + view.frame.x_scale.compute(x[0]), plot.y + view.frame.y_scale.compute(y[0])];
})()"""
TEXTS = """new Promise(next => setTimeout(next, 300)).then(() => {
    const text = [], walk = node => {
        if (node.nodeType === 3) text.push(node.data);
        if (node.tagName === "IMG" && !node.closest?.(".static")) text.push("AN IMAGE");
        if (!["STYLE", "SCRIPT"].includes(node.tagName))
            [...node.childNodes, ...(node.shadowRoot?.childNodes ?? [])].forEach(walk);
    };
    walk(document.body);
    return text;
})"""
SEEN = "getComputedStyle(document.querySelector('%s')).display"


def check(browser: Browser, page: Path, node: str) -> None:
    def ask(expression: str) -> Any:
        answer = browser.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    assert browser.open(page.as_uri(), 420).width <= 420
    assert ask(DRAWN % 1) == 2
    assert ask(TITLES) == ["node: near", f"node: {node}"]
    assert ask(ROWS) == 6  # three gains, two nodes, the first noise
    ask("document.getElementById('panels').children[1].scrollIntoView()")
    before = ask(TEXTS)
    x, y = ask(DOT)
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    known = ask(TEXTS)
    assert known.count(node) == before.count(node) + 1 and "AN IMAGE" not in known, known  # the dot says it, as text
    ask(CHOOSE % ("panel", "noise"))
    assert ask(DRAWN % 2) == 2
    assert ask(TITLES) == ["noise: 0.1", "noise: 0.2"] and ask(ROWS) == 12
    ask(CHOOSE % ("x", "node"))  # names along an axis, one of which looks like a formula
    ask(DRAWN % 3)
    ask("document.querySelector('#values fieldset input').click()")  # the first gain away
    ask(DRAWN % 4)
    assert ask(ROWS) == 8
    ask(CHOOSE % ("table", "1"))  # step by step: a panel for each state, and time below
    ask(DRAWN % 5)
    assert ask(TITLES) == ["state: x", "state: y"] and ask(ROWS) == 8
    assert ask("document.getElementById('x').value") == "time"
    ask(CHOOSE % ("y", "claimed"))  # which has no standard error
    ask(DRAWN % 6)
    assert ask("document.documentElement.scrollWidth") <= 420
    assert ask(SEEN % ".static") == "none" and ask(SEEN % "#explore") == "block"
    browser.call("Emulation.setEmulatedMedia", media="print")
    assert ask(SEEN % ".static") == "block" and ask(SEEN % "#explore") == "none"
    assert all(address.startswith(("file:", "data:")) for address in browser._requests()), browser._requests()
    assert browser._errors() == []


if __name__ == "__main__":
    with Browser() as browser:
        check(browser, Path(sys.argv[1]), sys.argv[2])
