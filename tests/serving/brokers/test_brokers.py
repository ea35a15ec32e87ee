"""Messages through real brokers: in order, acknowledged after the commit, and again if they were not."""

import asyncio
import logging
import shutil
import subprocess
from collections.abc import Iterator

import pytest

pytest.importorskip("nats")
pytest.importorskip("paho")
import nats
import nats.js.errors

from heliograph.serving import make_transport
from heliograph.serving.brokers.broker_address import parse_address
from heliograph.serving.brokers.transport import Part, TakenOverError, encode_name, part_of
from heliograph.serving.output import Output
from heliograph_studies.live.server import Server
from tests.serving.broker_servers import KINDS, at, made, numbered, published, received, running, sent, silent


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    yield from running(tmp_path_factory.mktemp("server"))


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch):
    """Connections that are tried again after a twentieth of a second at first, and not a quarter."""
    for module in ("mqtt", "nats", "transport"):
        monkeypatch.setattr(f"heliograph.serving.brokers.{module}.FIRST", 0.05)


def test_the_url_is_said_without_what_is_secret():
    result = parse_address("mqtts://me:p%40ss@example.org/site/one", {})
    assert (result.kind, result.host, result.port, result.topic) == ("mqtt", "example.org", 8883, "site/one")
    assert (result.user, result.password) == ("me", "p@ss") and result.secure
    assert "p@ss" not in f"{result!r}{result}" and "me:" not in f"{result!r}{result}"
    environment = {"HELIOGRAPH_BROKER_USER": "you", "HELIOGRAPH_BROKER_PASSWORD": "word"}
    assert parse_address("nats://me:old@example.org", environment).password == "word"
    assert parse_address("nats://example.org", {}).topic == "heliograph"


@pytest.mark.parametrize(
    "url", ["http://a:s3cret@b", "mqtt://", "nats://me:s3cret@h:x", "nats://h/a.b", "mqtt://h/a+b"]
)
def test_another_url_is_refused_in_one_line_without_the_password(url: str):
    with pytest.raises(ValueError, match=r"^broker") as error:
        parse_address(url, {})
    assert "s3cret" not in str(error.value) and "\n" not in str(error.value)


class Deaf:
    """A client of NATS that is cancelled while it flushes what it sends, or stalls: it goes on, or raises its own."""

    def __init__(self, error: Exception | None):
        self.error, self.received = error, 0

    async def fetch(self, *_: object, **__: object) -> list[bytes]:
        try:
            await asyncio.sleep(5)
        except asyncio.CancelledError:
            self.received += 1
            if self.received > 1:  # so that the test ends where it fails
                raise
        if self.error is not None:
            raise self.error
        return []

    publish_async = fetch


@pytest.mark.parametrize("error", [None, nats.errors.ConnectionClosedError(), nats.js.errors.TooManyStalledMsgsError()])
def test_one_cancellation_ends_a_wait_whatever_the_client_makes_of_it(error, monkeypatch):
    """Else it would stand still for as long as nothing comes."""

    async def work() -> None:
        transport = make_transport(parse_address("nats://127.0.0.1:1/away", {}))
        deaf = Deaf(error)
        monkeypatch.setattr(transport, "_reader", deaf)
        monkeypatch.setattr(transport, "_is_connected", lambda: True)
        monkeypatch.setattr(transport, "_open", lambda: asyncio.sleep(0, deaf))
        waits = [transport.receive] if error is None else [transport.receive, lambda: transport.publish(item)]
        for wait in waits:
            transport._reader = deaf
            task = asyncio.ensure_future(wait())
            await asyncio.sleep(0.01)
            task.cancel()
            done, _ = await asyncio.wait({task}, timeout=10)
            assert done and task.cancelled()

    item = [Output(1, "", "final", b"{}")]
    asyncio.run(work())


@pytest.mark.real("NATS")
def test_what_was_not_acknowledged_comes_again_in_order(server: Server):
    async def work() -> None:
        where = at(server, "nats", "again")
        first = await made(where)
        await sent(where, numbered(0, 1500))
        done = await received(first, 1)
        held = await received(first, 1, acknowledge=False)
        assert done + held == numbered(0, len(done + held)) and len(done) < 1500
        second = make_transport(where)  # as after kill -9: the first never says that it went
        await sent(where, numbered(1500, 1600))
        assert await received(second, 1600 - len(done)) == numbered(len(done), 1600)
        assert await silent(second)
        with pytest.raises(TakenOverError, match="one reader"):
            first._reader = None
            await asyncio.wait_for(first.receive(), 10)
        await asyncio.gather(first.close(), second.close())

    asyncio.run(work())


@pytest.mark.real("NATS")
def test_a_server_that_is_killed_is_tried_again_and_nothing_is_missed(tmp_path, caplog, impatient):
    async def work() -> None:
        where = parse_address(f"nats://me:s3cret@127.0.0.1:{server.nats}/site", {})
        reader = await made(where)
        await sent(where, numbered(0, 100))
        before = await received(reader, 100)
        server.kill()
        waiting = asyncio.ensure_future(received(reader, 100))
        await asyncio.sleep(0.3)
        server.start()
        await sent(where, numbered(100, 200))
        assert before + await waiting == numbered(0, 200)
        await reader.close()

    server = Server(tmp_path)
    server.start()
    try:
        with caplog.at_level(logging.DEBUG):
            asyncio.run(work())
    finally:
        server.kill()
    assert "trying again" in caplog.text and "s3cret" not in caplog.text
    assert ": connected" in caplog.text


@pytest.mark.real("NATS")
def test_the_server_cuts_plants_into_parts_as_we_do(server: Server):
    async def work() -> None:
        where, parts = at(server, "nats", "shared"), 3
        readers = [await made(where, Part(i, parts)) for i in range(parts)]
        plants = ["", "mower", "Ω.1", *(f"plant {i}" for i in range(20))]
        for plant in plants:
            await sent(where, [plant.encode()], plant)
        for i, reader in enumerate(readers):
            mine = [plant for plant in plants if part_of(plant, parts) == i]
            assert mine and [body.decode() for body in await received(reader, len(mine))] == mine
        other = make_transport(where, Part(0, 4))
        with pytest.raises(ValueError, match="one of 4 parts"):
            await other.receive()
        await asyncio.gather(*[reader.close() for reader in [*readers, other]])

    asyncio.run(work())


@pytest.mark.real("MQTT")
def test_a_session_keeps_what_was_not_acknowledged(server: Server):
    async def work() -> None:
        where = at(server, "mqtt", "session")
        first = make_transport(where)
        await asyncio.sleep(0.3)  # the session is there once it was connected
        await asyncio.to_thread(published, where, numbered(0, 100))
        assert await received(first, 100) == numbered(0, 100)
        await asyncio.to_thread(published, where, numbered(100, 200))
        assert await received(first, 100, acknowledge=False) == numbered(100, 200)
        await first.close()
        await asyncio.to_thread(published, where, numbered(200, 300))
        second = make_transport(where)
        result = set[
            bytes
        ]()  # this server sends what is new first, the rest after a second, and again on a busy machine
        while len(result) < 200:
            result |= set(await received(second, 1))
        assert result == set(numbered(100, 300))
        await second.close()

    asyncio.run(work())


@pytest.mark.real("MQTT")
def test_a_sender_to_mqtt_writes_the_part_into_the_topic(server: Server):
    async def work() -> None:
        where = at(server, "mqtt", "parted")
        readers = [make_transport(where, Part(i, 2)) for i in range(2)]
        await asyncio.sleep(0.5)
        for plant in ("a", "b", "c", "d"):
            below = f"{part_of(plant, 2)}/{encode_name(plant)}"
            await asyncio.to_thread(published, where, [plant.encode()], below)
        for i, reader in enumerate(readers):
            mine = [plant for plant in "abcd" if part_of(plant, 2) == i]
            assert mine and [body.decode() for body in await received(reader, len(mine))] == mine
        await asyncio.gather(*[reader.close() for reader in readers])

    asyncio.run(work())


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl here: apt-get install openssl")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # paho leaves sockets to the collector
def test_a_connection_is_encrypted_and_says_who_it_is(kind, tmp_path, monkeypatch, caplog, impatient):
    certificate, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    what = ["-subj", "/CN=here", "-addext", "subjectAltName=IP:127.0.0.1", "-keyout", key, "-out", certificate]
    subprocess.run(["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", *what], check=True, capture_output=True)
    tls = f'tls {{ cert_file: "{certificate}", key_file: "{key}" }}\n'
    server = Server(tmp_path)
    text = server.file.read_text().replace("mqtt {", f"mqtt {{ {tls}")
    server.file.write_text(f'{text}{tls}authorization {{ user: me, password: "s3cret word" }}\n')
    server.start()
    scheme = "nats+tls" if kind == "nats" else "mqtts"
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    where = f"{scheme}://127.0.0.1:{getattr(server, kind)}/safe"
    outputs = [Output(i, "", "final", str(i).encode()) for i in range(3)]

    async def report(url: str, environment: dict[str, str]) -> bool:
        """Whether the broker took it, or did not let us in twice."""
        transport, before = make_transport(parse_address(url, environment)), caplog.text.count("trying again")
        work = asyncio.create_task(transport.publish(outputs))
        async with asyncio.timeout(20):
            while not work.done() and caplog.text.count("trying again") < before + 2:
                await asyncio.sleep(0.01)
        result = work.done()
        work.cancel()
        await asyncio.wait([work])
        await transport.close()
        return result

    who = {"HELIOGRAPH_BROKER_USER": "me", "HELIOGRAPH_BROKER_PASSWORD": "s3cret word"}
    try:
        with caplog.at_level(logging.DEBUG):
            assert asyncio.run(report(where, who))
            assert asyncio.run(report(where.replace("://", "://me:s3cret%20word@"), {}))
            assert not asyncio.run(report(where, who | {"HELIOGRAPH_BROKER_PASSWORD": "s3cret"}))
            monkeypatch.delenv("SSL_CERT_FILE")  # nobody vouches for it now
            assert not asyncio.run(report(where, who))
    finally:
        server.kill()
    assert "trying again" in caplog.text and "s3cret" not in caplog.text
    assert ": connected" in caplog.text and "its certificate is not trusted: self-signed certificate" in caplog.text
