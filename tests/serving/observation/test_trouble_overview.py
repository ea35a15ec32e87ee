"""All plants, the worst first: on a page, in metrics that know plants, and by counters that never fall."""

import asyncio
import json

import numpy as np
import pytest
from pydantic_core import to_json

from heliograph.live import LinkCounts
from heliograph.serving.observation import parse_page_address, serve_page
from heliograph.serving.observation.running_nis import read_nis
from heliograph.serving.output import Output
from tests.serving.observation.test_page import TOKEN, got
from tests.serving.watched import Scripted, observer_of


def fleet(count, wrong=3, dead=5):
    """A watch of so many plants: of one the innovations are 16 times what is claimed, of one a sender is dead."""
    watch, services = observer_of(["x"], "oven"), []
    for i in range(count):
        status = {"last": 3, "silent": 9, "provisional": 0, "missed": 3, "chance": 1e-9, "dead": True}
        senders = {"<b>node": status} if i == dead else {}
        service = Scripted(16.0 if i == wrong else 1.0, f"p{i}", senders=senders)
        watch.wrap(service).take([str(k).encode() for k in range(150)])
        services.append(service)
    return watch, services


def looked(watch, look, at=None):
    async def work():
        async with serve_page(watch, at or parse_page_address("0", {})) as port:
            await look(f"http://127.0.0.1:{port}")

    asyncio.run(work())


def metrics(text):
    return dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))


@pytest.mark.real("browser")
def test_what_is_wrong_is_read_on_a_phone(fits):
    """It stood to the right of a window of 400 pixels, in one long line."""

    async def look(url):
        await asyncio.to_thread(fits, f"{url}/plants")

    looked(fleet(6)[0], look)


@pytest.mark.parametrize("count", [20, 60])
def test_one_wrong_plant_of_many_is_seen(count):
    """Pooled, its ratio of 16 is hardly seen; where there are many plants the worst have metrics of their own."""

    async def look(url):
        result = metrics((await got(f"{url}/metrics"))[1])
        label = 'filter="cubature",node="<b>node",plant="p3"'
        assert float(result[f"heliograph_plant_nis{{{label}}}"]) > 12
        assert float(result[f"heliograph_plant_nis_high{{{label}}}"]) < 1.5
        assert (f"heliograph_plant_nis{{{label.replace('p3', 'p7')}}}" in result) == (count == 20)
        assert result['heliograph_plants_wrong{what="doubted claim"}'] == "1.0"
        assert result['heliograph_plants_wrong{what="dead sender"}'] == "1.0"
        assert result['heliograph_plant_dead_sender{node="<b>node",plant="p5"}'] == "1.0"
        page = (await got(f"{url}/plants"))[1]
        rows = [page.index(f">p{i}</a>") for i in (5, 3, 0)]
        assert rows == sorted(rows) and f"oven: {count} plants, 2 with something wrong" in page
        assert "its sender is dead" in page and "&lt;b&gt;node" in page and "<b>node" not in page
        chosen = (await got(f"{url}/?plant=p3"))[1].split('id="first">')[1].split("</script>")[0]
        assert json.loads(chosen)["plant"] == "p3" and json.loads(chosen)["wrong"] == 2

    looked(fleet(count)[0], look)


def test_counters_do_not_follow_what_is_in_memory():
    watch, services = fleet(6)
    before = watch.links()["<b>node"]
    assert before["used"] == 6 * 150
    services[0].plants["p0"].links["<b>node"].lost = 4
    watch.note([Output(None, "p0", "refused", b"{}")], None)
    assert watch.links()["<b>node"]["lost"] == 4
    gone = services[0].plants.pop("p0")
    assert watch.links()["<b>node"]["used"] == 900
    services[0].plants["p0"] = gone  # it comes back, and counts on
    gone.links["<b>node"].used += 1
    gone.links["<b>node"].lost = 1
    watch.note([Output(None, "p0", "refused", b"{}")], None)
    after = watch.links()["<b>node"]
    assert after["used"] == 901 and after["lost"] == 1
    gone.links["<b>node"] = LinkCounts(used=3)  # begun anew
    watch.note([Output(None, "p0", "refused", b"{}")], None)
    assert watch.links()["<b>node"]["used"] == 901


def test_health_is_said_to_everybody_and_all_pages_are_there_while_a_batch_is_long(monkeypatch):
    watch = fleet(2)[0]
    pages = ("/", "/plants", "/metrics", "/?plant=p1")

    async def look(url):
        assert (await got(f"{url}/healthz"))[:2] == (200, "ok")
        assert (await got(f"{url}/metrics"))[0] == 401
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        before = [await got(url + page, **bearer) for page in pages]
        monkeypatch.setattr("heliograph.serving.observation.answers_between_batches.PATIENCE", 0.01)
        with watch.taking_batch():
            assert [await got(url + page, **bearer) for page in pages] == before
            assert (await got(f"{url}/healthz"))[0] == 200
            monkeypatch.setattr("heliograph.serving.observation.page.STUCK", 0.0)
            status, text, _ = await got(f"{url}/healthz")
            assert status == 503 and "a batch has been taken for" in text

    looked(watch, look, parse_page_address("0", {"HELIOGRAPH_PAGE_TOKEN": TOKEN}))


def test_the_first_batch_may_be_long_and_all_pages_are_there(monkeypatch):
    """Twelve event senders took 31 s to answer at /, since the first batch compiles."""
    monkeypatch.setattr("heliograph.serving.observation.answers_between_batches.PATIENCE", 0.01)
    watch = observer_of(["x"])

    async def look(url):
        with watch.taking_batch():
            for page in ("/", "/plants", "/metrics", "/healthz"):
                assert (await got(url + page))[0] == 200

    looked(watch, look)


def test_a_token_holds_wherever_it_is_set_and_hosts_are_a_setting():
    environment = {"HELIOGRAPH_PAGE_TOKEN": TOKEN}
    assert (
        parse_page_address("8000", environment).token
        == parse_page_address("localhost:8000", environment).token
        == TOKEN
    )
    with pytest.raises(ValueError, match="a token of 16 characters at least in HELIOGRAPH_PAGE_TOKEN, got one of 5"):
        parse_page_address("8000", {"HELIOGRAPH_PAGE_TOKEN": "short"})
    for wrong in ("http://a", "a:80", "", "a b"):
        with pytest.raises(ValueError, match="a name without scheme and port"):
            parse_page_address("8000", {}, [wrong])
    at = parse_page_address("0", {}, ["pages.example.org"])

    async def look(url):
        assert (await got(url, Host="pages.example.org"))[0] == (await got(url, Host="localhost:80"))[0] == 200
        assert (await got(url, Host="elsewhere.example.org"))[0] == 400

    looked(fleet(1)[0], look, at)


def test_what_a_gate_left_out_does_not_count_against_it():
    """Its innovations are chi-squared but for one in ten, ten deviations off, of weight 0: the claim is right."""
    rng, watch = np.random.default_rng(1), observer_of(["x"])
    for k in range(400):
        outlier = k % 10 == 0
        value = 10.0 if outlier else rng.normal()
        weighed = {"value": [value], "variance": [1.0], "weight": [0.0 if outlier else 1.0]}
        filters = {"gate": {"mean": [0.0], "covariance": [[1.0]], "claim": "nominal", "nis": value**2, "received": 1}}
        filters["gate"]["outputs"] = weighed
        body = to_json({"kind": "final", "plant": "p", "time": k, "estimates": {"a": filters}})
        watch.note([Output(k, "p", "final", body)], None)
    assert watch.tests("p")["a", "gate"].explain_doubt() is None and not watch.list_worst_plants()
    none = {"nis": 100.0, "received": 1, "outputs": {"value": [10.0], "variance": [1.0], "weight": [0.0]}}
    assert read_nis(none) == (None, 0) and read_nis({"nis": 2.0, "received": 2}) == (2.0, 2)
