"""The page and its metrics: what is shown, to whom, and that nothing which comes from outside becomes markup."""

import asyncio
import json
import re
import socket
import urllib.request
from collections.abc import Awaitable, Callable
from typing import Any
from urllib.error import HTTPError

import numpy as np
import pytest
from scipy.stats import chi2

import heliograph as hg

pytest.importorskip("uvicorn")
from heliograph.files.sources import TopicReader
from heliograph.live import LinkCounts
from heliograph.serving.observation import parse_page_address, serve_page, watch_of
from heliograph.serving.observation.running_nis import RunningNis
from tests.serving.watched import Scripted, metrics_of, observer_of
from tests.serving.worlds import stepping
from tests.widths import program

TOKEN = "a token of enough letters"


def looked(
    look: Callable[[str], Awaitable[None]],
    service: Scripted,
    rows: int = 300,
    token: str | None = None,
    watch: Any = None,
) -> None:
    """Look at a page of a service that has taken so many rows."""
    watch = observer_of(["<i>x</i>", "v"]) if watch is None else watch
    watch.wrap(service).take([str(i).encode() for i in range(rows)])

    async def work() -> None:
        environment = {} if token is None else {"HELIOGRAPH_PAGE_TOKEN": token}
        async with serve_page(watch, parse_page_address("0", environment)) as port:
            await look(f"http://127.0.0.1:{port}")

    asyncio.run(work())


async def got(url: str, **headers: str) -> tuple[int, str, dict[str, str]]:
    def ask() -> tuple[int, str, dict[str, str]]:
        try:
            with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10) as answer:
                return answer.status, answer.read().decode(), dict(answer.headers)
        except HTTPError as error:
            return error.code, error.read().decode(), dict(error.headers)

    return await asyncio.to_thread(ask)


async def first_event(url: str) -> dict[str, object]:
    def ask() -> dict[str, object]:
        with urllib.request.urlopen(url, timeout=10) as answer:
            line = answer.readline()
            return json.loads(line.removeprefix(b"data: "))

    return await asyncio.to_thread(ask)


def test_an_honest_filter_stays_in_its_band_and_a_wrong_one_does_not():
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(300):
        item = RunningNis("exact")
        for squared, single in zip(rng.chisquare(2, 600), [2] * 600, strict=True):
            item.add(squared, single)
        low, high = item.band()
        inside.append(low <= item.ratio <= high)
    assert np.mean(inside) > 0.99  # 300 tries of probability 0.001: more than 2 failures once in 4,000
    fresh = RunningNis("exact", mean=10.0, variance=20.0)  # ten numbers, all of weight 1: chi-squared itself
    assert np.allclose(fresh.band(), chi2.ppf([0.0005, 0.9995], 10) / 10, rtol=1e-12)
    for scale, claim, doubted in [
        (2.0, "exact", True),
        (0.5, "exact", True),
        (0.5, "upper", False),
        (1.0, "exact", False),
    ]:
        item = RunningNis(claim)
        for squared in scale * rng.chisquare(2, 600):
            item.add(squared, 2)
        assert (item.explain_doubt() is not None) == doubted


def test_a_door_that_others_reach_needs_a_token():
    here, open_ = parse_page_address("8000", {}), parse_page_address("0.0.0.0:8000", {"HELIOGRAPH_PAGE_TOKEN": TOKEN})
    assert (here.host, here.port, here.token, here.hosts) == ("127.0.0.1", 8000, None, ())
    assert (open_.host, open_.port, open_.token) == ("0.0.0.0", 8000, TOKEN)
    assert parse_page_address("[::1]:80", {}).token is None
    for place in ("0.0.0.0:8000", "[::]:8000", "example.org:80"):
        with pytest.raises(ValueError, match="a token of 16 characters"):
            parse_page_address(place, {"HELIOGRAPH_PAGE_TOKEN": "short"})
    for place in ("http://a", "a:b", "", "70000"):
        with pytest.raises(ValueError, match="a port, or address:port"):
            parse_page_address(place, {})


def test_the_page_shows_what_was_said_and_brings_all_it_needs():
    async def look(url: str) -> None:
        _, text, headers = await got(url)
        assert "default-src 'none'" in headers["content-security-policy"]
        outside = re.findall(r'(?:src|href)="([^"]*)"', text)
        assert sorted(outside) == ["page.css", "page.js"] and "http" not in (await got(f"{url}/page.css"))[1]
        match = re.search(r'id="first">(.*?)</script>', text)
        assert match is not None and "<" not in match[1]  # a name does not end the element
        view = json.loads(match[1])
        assert view == await first_event(f"{url}/events")
        assert view["states"][0] == "<i>x</i>" and view["plants"] == ["</script><b>x"] and len(view["points"]) == 600
        point = view["points"][-1]["estimates"]["<b>node"]["cubature"]
        assert point["mean"][0] == np.sin(299 / 20) and point["deviation"][1] == pytest.approx(0.1)
        assert point["modes"] == [0.75, 0.25]
        assert view["links"]["<b>node"]["used"] == 300 and view["tests"][0]["doubt"]
        assert "times what its covariance says" in view["warnings"][0]

    looked(look, Scripted(3.0, "</script><b>x"))


def test_metrics_are_those_of_the_service():
    async def look(url: str) -> None:
        text = (await got(f"{url}/metrics"))[1]
        result = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
        assert result['heliograph_messages_total{node="<b>node",verdict="used"}'] == "300.0"
        label = '{filter="cubature",node="<b>node"}'
        low, ratio, high = (float(result[f"heliograph_nis{name}{label}"]) for name in ("_low", "", "_high"))
        assert 0.7 < low < ratio < high < 1.4
        assert result["heliograph_commit_seconds_count"] == "1.0" and result["heliograph_plants"] == "1.0"
        assert result["heliograph_lag_seconds_sum"] == "40.0"

    looked(look, Scripted())


def test_only_who_has_the_token_gets_in():
    async def look(url: str) -> None:
        for path in ("/", "/events", "/metrics", "/page.js", "/?token=wrong", "/?token=%C3%A9"):
            status, text, _ = await got(f"{url}{path}")
            assert status == 401 and TOKEN not in text
        status, text, _ = await got(f"{url}/metrics", Authorization=f"Bearer {TOKEN}")
        assert status == 200 and "heliograph_plants" in text
        status, text, _ = await got(url, Cookie="heliograph=" + TOKEN.replace(" ", "%20"))
        assert status == 401  # a cookie is what the page itself set
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        opened = await asyncio.to_thread(opener.open, f"{url}/?token={TOKEN.replace(' ', '+')}", None, 10)
        assert opened.status == 200 and "token" not in opened.url

    looked(look, Scripted(), token=TOKEN)


def test_a_page_of_elsewhere_that_takes_our_name_does_not_get_in():
    async def look(url: str) -> None:
        assert (await got(f"{url}/metrics", Host="evil.example"))[0] == 400
        assert (await got(f"{url}/metrics", Host="localhost:80"))[0] == 200

    looked(look, Scripted())


def test_a_page_that_is_open_does_not_hold_a_service_that_ends(capfd):
    """Its server waited a second for the reader, then wrote a traceback."""
    reader = socket.socket()

    async def look(url: str) -> None:
        host, port = url.removeprefix("http://").split(":")
        reader.connect((host, int(port)))
        reader.sendall(f"GET /events HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        assert b"200 OK" in await asyncio.to_thread(reader.recv, 15)

    with reader:
        looked(look, Scripted())
    assert capfd.readouterr().err == ""


def test_what_is_lost_of_messages_without_a_count_is_not_counted():
    """It was 0, which nobody knows; nodes that count have theirs."""
    sources = {
        "attic": hg.files.json_field("t", "a", time_unit="step", time="k"),
        "cellar": hg.files.json_field("t", "b", time_unit="step", time="k", sequence="n"),
    }
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    node = hg.Node(sensor, hg.perfect(), {"kalman": hg.kalman_filter(plant, sensor)})
    network = hg.Network(plant, {"a": node, "b": node})
    uncounted = TopicReader(sources, network).nodes_without_count
    assert uncounted == {"a"}
    watch = watch_of(network, "house", uncounted)
    watch.totals.add_plant("", {name: LinkCounts(used=3, lost=0) for name in "ab"})
    assert {name: link["lost"] for name, link in watch.links().items()} == {"a": None, "b": 0}
    said = metrics_of(watch)
    assert 'heliograph_lost{node="b"} 0' in said and 'heliograph_lost{node="a"}' not in said


def test_many_nodes_have_one_warning_of_a_kind():
    watch, service = observer_of(["x", "v"]), Scripted(nodes=5)
    watch.wrap(service).take([b"0"])
    for i, link in enumerate(service.plants["mower"].links.values()):
        link.late, link.future = i, int(i == 3)
    late, clock = watch.make_page_data(None)["warnings"]
    assert late.startswith("node 1, node 2, node 3, node 4: 10 came too late") and clock.startswith(
        "node 3: 1 of a time that is not yet"
    )


async def drawn(url: str) -> str:
    """Return a page as a browser has drawn it."""
    arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--timeout=4000", "--dump-dom", url]
    browser = await asyncio.create_subprocess_exec(str(program()), *arguments, stdout=-1, stderr=-3)
    return (await browser.communicate())[0].decode()


SENDERS = {
    "node 1": {
        "last": 290,
        "silent": 5,
        "provisional": 4,
        "missed": 0,
        "chance": 1.0,
        "dead": False,
        "reason": "",
        "unit": "steps",
    },
    "node 2": {
        "last": 3,
        "silent": 292,
        "provisional": 4,
        "missed": 9,
        "chance": 1e-5,
        "dead": True,
        "reason": "9 heartbeats did not come, by chance once in 100,000",
        "unit": "steps",
    },
}


def passing(ahead, by, then):
    """What is forecast at one horizon of a level of the velocity."""
    said = {"then": then, "by": by, "by_error": 0.01}
    return {"ahead": ahead, "estimates": {"node 0": {"cubature": {"thresholds": {"<b>v>1": said}}}}}


FORECAST = [passing(5.0, 0.034, 0.02), passing(60.0, 0.95, 0.4)]


def test_a_fusion_of_estimates_is_judged_by_what_it_fuses_and_a_dead_sender_is_a_warning():
    assert watch_of(stepping(), "tank").fused == {"both": ("upper", [("a", "linear"), ("b", "linear")])}
    for scale, doubted in ((1.0, False), (3.0, True)):
        watch = observer_of(["x", "v"], "tank")
        assert watch.make_page_data(None)["tests"] == []  # nothing to judge by yet
        watch.wrap(Scripted(scale, nodes=2, senders=SENDERS)).take([str(i).encode() for i in range(300)])
        view = watch.make_page_data(None)
        fused = view["tests"][-1]
        assert (fused["node"], fused["filter"], fused["claim"], fused["doubt"]) == ("fused", "both", "upper", doubted)
        assert fused["by"] == ["node 0/cubature", "node 1/cubature"] and fused["numbers"] == 2 * 600
        assert f'heliograph_fusion_doubted{{filter="both"}} {float(doubted)}' in metrics_of(watch)
        assert view["senders"] == SENDERS
        dead = "node 2: its sender is dead: 9 heartbeats did not come, by chance once in 100,000"
        assert [line for line in view["warnings"] if "sender" in line] == [dead]


@pytest.mark.real("browser")
def test_a_browser_draws_axes_with_units_what_is_not_final_and_the_state_of_senders(fits):
    watch = observer_of({"position": "m", "v": ""}, "tank", ["dt"])

    async def look(url: str) -> None:
        await asyncio.to_thread(fits, f"{url}/")
        text = await drawn(url)
        assert "<title>tank</title>" in text and 'id="title">tank</h1>' in text and "plant mower" in text
        assert "<b>position (m)</b>" in text and ">time (s)</text>" in text
        # sin(299 / 20) = 0.6874 with 2 sqrt(0.04 (1 + 4 / 300)) = 0.4027: two digits of the deviation
        assert "0.69 ± 0.40 m (two deviations), nominal" in text
        figure = text[text.index("<svg") : text.index("</svg>")]
        assert figure.count("<circle") == figure.count('class="bar"') == 4
        ticks = [float(tick) for tick in re.findall(r'class="tick end"[^>]*>(-?[\d.]+)<', figure)]
        assert len(ticks) >= 3 and np.allclose(np.diff(ticks), ticks[1] - ticks[0]) and min(ticks) < 0 < max(ticks)
        (path,) = re.findall(r'class="mean" d="([^"]*)"', figure)
        assert path.count("L") == 300 - 4 - 1  # the line ends with the last final estimate
        names = re.findall(r'<th scope="row">(node \d+)</th>', text)
        assert names == [f"node {i}" for i in range(14)] and '<p id="search" class="choices">' in text
        assert (
            ">14 nodes</span>" in text
            and ">silent for 5 steps</td>" in text
            and ">dead: 9 heartbeats missed</td>" in text
        )
        # Levels, with how far ahead in the unit of time; what is likely stands out.
        levels = text[text.index('id="passing"') : text.index('id="links-title"')]
        assert re.findall(r"<th scope=\"col\">([^<]*)</th>", levels) == ["level", "filter", "in 5 s", "in 60 s"]
        assert '<th scope="row">&lt;b&gt;v&gt;1</th><td>node 0/cubature</td><td>3.4 % (2.0 %)</td>' in levels
        assert '<td class="doubt">95 % (40 %)</td>' in levels

    looked(look, Scripted(nodes=14, waiting=4, senders=SENDERS, forecast=FORECAST), watch=watch)


@pytest.mark.real("browser")
def test_a_browser_draws_it_and_runs_nothing_that_came_from_outside(fits):
    async def look(url: str) -> None:
        await asyncio.to_thread(fits, f"{url}/")
        text = await drawn(url)
        body = text[text.index("<main>") : text.index("</main>")]
        assert body.count("<svg") == 4 and 'class="area"' in body  # of two states and two modes
        assert "<b>probability of mode 1</b>" in body and "0.25, nominal" in body
        assert "&lt;b&gt;node" in body and "&lt;i&gt;x" in body and "<b>node" not in body and "<i>" not in body
        assert ">doubtful</td>" in body and "400" in body

    looked(look, Scripted(3.0, "<img src=x onerror=alert(1)>"), rows=400)
