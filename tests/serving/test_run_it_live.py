"""The commands of the README and of docs/run_it_live.md that talk through pipes, and what they refuse."""

import json
import os
import re
import shlex
from contextlib import contextmanager
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from heliograph import cli
from heliograph.serving.message import Message
from heliograph.serving.output import Estimates, Refused
from heliograph.serving.settings import choose_store_location
from tests.serving.worlds import lines, messages

ROOT = Path(__file__).resolve().parents[2]
SAID = Path("said")  # what the last command of a pipe said beside its lines
PIPED = re.compile(r"^\$ (heliograph (?:replay|serve).*)$", re.MULTILINE)
SMALL = """
import heliograph as hg
plant = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5, [[1.0]], inputs=["push"])
sensor, hop = hg.LinearSensor([[1.0]], 0.1), hg.hop(hg.Discrete([0.6, 1.2], [0.5, 0.5]), 0.05)
node = hg.Node(sensor, hop, {"linear": hg.linear_filter(plant, sensor, hop)})
network = hg.Network(plant, {"a": node, "b": node}, {"both": hg.Fusion("linear", hg.fusion.EqualIntersection())})
"""


@contextmanager
def standard(number, path, flags):
    """A standard file that is another one for a while."""
    stored, other = os.dup(number), os.open(path, flags, 0o600)
    os.dup2(other, number)
    try:
        yield
    finally:
        os.dup2(stored, number)
        os.close(stored)
        os.close(other)


def piped(command, capfd):
    """What a line of a shell gives: its parts one after another, each reading what the one before wrote."""
    command, _, source = command.partition(" < ")
    source = Path(source or os.devnull)
    for i, part in enumerate(command.split(" | ")):
        target = Path(f"piped{i}")
        with (
            capfd.disabled(),
            standard(0, source, os.O_RDONLY),
            standard(1, target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
            standard(2, SAID, os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
        ):
            assert cli.main(shlex.split(part)[1:]) == 0
        source = target
    return [json.loads(line) for line in source.read_text().splitlines()]


@pytest.mark.slow
def test_the_pipe_of_the_readme_gives_final_estimates(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (command,) = PIPED.findall((ROOT / "README.md").read_text())
    page = PIPED.findall((ROOT / "docs/run_it_live.md").read_text())
    assert page[0] == command
    assert cli.main(["new", "cart.py"]) == 0
    rows = [f"{k / 10},0.0,0.1,{k / 10 + 0.01 * (k % 7)},{10 - k / 10}" for k in range(200)]
    Path("data.csv").write_text("\n".join(["time,acceleration,dt,left,right", *rows]))
    known = piped(command.replace("--speed 10", "--speed 1000"), capfd)
    reader = TypeAdapter(Estimates | Refused)
    for item in known:
        reader.validate_python(item)
    finals = [item["time"] for item in known if item["kind"] == "final"]
    assert finals == sorted(finals)
    assert 50 < len(finals) < 150  # of 20 s of which the last 10 may still change
    assert {item["reason"] for item in known if item["kind"] == "refused"} == {"duplicate"}
    (tmp_path / "messages.jsonl").write_text((tmp_path / "piped0").read_text())
    again = piped(page[1], capfd)
    stored = [item["estimates"] for item in again if item["kind"] == "final"]  # of the rest may still change
    assert (
        stored == [item["estimates"] for item in known if item["kind"] == "final"][: len(stored)] and len(stored) > 50
    )


@pytest.mark.slow
def test_the_state_is_stored_next_to_the_network_by_default(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("net.py").write_text(SMALL)
    Path("sent").write_bytes(b"\n".join(lines(messages(1, 40, 0, whole=True, longest=0.0))))

    def served(options=""):
        known = piped(f"heliograph serve net.py --window 5{options} < sent", capfd)
        finals = [item for item in known if item["kind"] == "final"]
        return len(finals), {item["reason"] for item in known if item["kind"] == "refused"}, SAID.read_text()

    count, refused, said = served()
    assert count == 14 and not refused  # of steps 0 to 19 those before 14
    assert said == "heliograph: the state is kept in net.db, plants so far: 0 (--store none keeps nothing)\n"
    count, refused, said = served()
    assert (count, refused) == (0, {"late", "duplicate"}) and "plants so far: 1 " in said
    assert "heliograph: 40 messages were known already or came after what was final" in said
    assert said.count("\n") == 2 and "to begin anew, delete net.db or name another --store" in said
    count, refused, said = served(" --store none")
    assert (count, refused, said) == (20, set(), "")
    assert cli.main(["serve", "net.py"]) == 2  # of another window
    said = capfd.readouterr().err
    assert "got one that differs: option window: 5.0 -> 10.0; to begin" in said and said.endswith(
        "; --accept-changes goes on with what fits\n"
    )


def retuned(store, capfd):
    """Serve 20 steps, then 10 more with another noise of the plant, which is refused unless it is accepted."""
    Path("net.py").write_text(SMALL)
    sent = [json.loads(line) for line in lines(messages(1, 60, 0, whole=True, longest=0.0))]
    for name, part in (("first", sent[:40]), ("rest", sent[40:])):
        Path(name).write_text("\n".join(map(json.dumps, part)))
    command = f"heliograph serve net.py --window 5 --store {shlex.quote(store)}"
    first = piped(f"{command} < first", capfd)
    Path("net.py").write_text(SMALL.replace("0.04", "0.09"))
    assert cli.main(shlex.split(command)[1:]) == 2
    said = capfd.readouterr().err
    assert "differs: plant.noise.covariance: 0.04 -> 0.09" in said
    assert said.endswith("; --accept-changes goes on with what fits\n")
    second = piped(f"{command} --accept-changes < rest", capfd)
    assert "plant.noise.covariance: 0.04 -> 0.09\n" in SAID.read_text()
    assert "numbers of" not in SAID.read_text() and "begins with the initial law" not in SAID.read_text()
    times = [[item["time"] for item in part if item["kind"] == "final"] for part in (first, second)]
    assert times[0] == [float(k) for k in range(14)] and times[1] == [float(k) for k in range(14, 24)]
    ids = [item["id"] for item in (*first, *second) if item["kind"] == "final"]
    assert ids == list(range(1, 25))  # the journal goes on
    claimed = [[item["estimates"]["a"]["linear"]["covariance"][0][0] for item in part if item["kind"] == "final"]
               for part in (first, second)]  # fmt: skip
    assert claimed[1][-1] > claimed[0][-1]  # more noise, in steady state


@pytest.mark.slow
def test_a_network_that_was_retuned_goes_on_from_its_store(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    retuned("net.db", capfd)


def test_a_store_is_called_as_its_network():
    for network, name in (
        ("a/cart.py", "cart.db"),
        ("cart.py:b", "cart-b.db"),
        ("pack.cart:b", "cart-b.db"),
        ("pack.cart", "cart.db"),
    ):
        assert choose_store_location(network, None, None) == name
    assert choose_store_location("cart.py", None, 3) is None and choose_store_location("cart.py", "x.db", 3) == "x.db"


def test_what_serve_and_replay_refuse_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("net.py").write_text(SMALL)
    Path("link.csv").write_text("lag\n1.0\n")
    Path("events.csv").write_text("node,sequence,time,values\na,0,0,1.0\n")
    for words, what in (
        (["serve"], "serve: expected a network"),
        (["serve", "net.py", "--window", "-1"], "window"),
        (["serve", "net.py", "--store", "none", "--from-snapshot", "a.db"], "--store FILE"),
        (["serve", "net.py", "--store", "b.db", "--from-snapshot", "a.db"], "nothing of that name"),
        (["replay", "events.csv", "--network", "net.py", "--speed", "0"], "--speed"),
        (["replay", "events.csv", "--network", "net.py", "--loss", "2"], "loss"),
        (["replay", "events.csv", "--network", "net.py", "--loss", "0.1", "--trace", "events.csv"], "--trace"),
        (["replay", "events.csv", "--network", "net.py", "--trace", "link.csv"], "delay"),
    ):
        assert cli.main(words) == 2
        known = capsys.readouterr().err
        assert known.startswith("heliograph: ") and what in known and known.count("\n") == 1, known


def test_the_schema_is_that_of_messages_and_outputs(capsys):
    assert cli.main(["serve", "--schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert set(schema) == {"message", "output"}
    assert schema["message"]["required"] == ["node", "sequence", "time"]
    assert set(schema["message"]["properties"]) == set(Message.model_fields)
    assert set(schema["output"]["$defs"]["Estimates"]["properties"]) == set(Estimates.model_fields)
    page = (ROOT / "docs/run_it_live.md").read_text()
    (example,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    Message.model_validate_json(example)
    assert {f"`{name}`" for name in Message.model_fields} <= set(re.findall(r"^\| (`\w+`) \|", page, re.MULTILINE))
    for line in lines(messages(1, 3, 0, whole=True)):
        Message.model_validate_json(line)
