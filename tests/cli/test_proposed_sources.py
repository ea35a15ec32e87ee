"""`heliograph inspect` of files of messages: the sources that it proposes are Python that runs."""

import json

import heliograph as hg
from heliograph import cli
from tests.cli.test_field_data import UPLINKS


def test_inspect_proposes_what_looks_like_the_measurement_and_the_count(tmp_path, monkeypatch, capsys):
    """Of a LoRaWAN device, and of one with a battery and a link; what it proposes is Python that runs."""
    monkeypatch.chdir(tmp_path)
    frame = json.loads(json.loads(UPLINKS[1])["payload"])
    frame["uplink_message"] |= {
        "rx_metadata": {"rssi": -80},
        "settings": {"data_rate": {"lora": {"bandwidth": 125000}}},
    }
    lines = [json.dumps({"topic": "v3/up", "payload": json.dumps(frame)})]
    lines.append('{"topic": "zigbee2mqtt/attic", "payload": {"battery": 98, "linkquality": 80, "temperature": 20.5}}')
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    assert cli.main(["inspect", "log.jsonl"]) == 0
    said = capsys.readouterr().out
    scope: dict[str, object] = {"hg": hg}
    exec(said[said.index("sources = {") :], scope)
    up = hg.files.json_field(
        "uplink_message.decoded_payload.t", "NODE", "OUTPUT", time="received_at", sequence="uplink_message.f_cnt"
    )
    assert scope["sources"] == {
        "v3/up": up,
        "zigbee2mqtt/attic": hg.files.json_field("temperature", "NODE", "OUTPUT"),
    }
    (tmp_path / "table.csv").write_text("battery,level,seq,at\n98,1.5,1,2026-09-27T10:00:00Z\n")
    assert cli.main(["inspect", "table.csv"]) == 0
    assert "json_field('level', node='NODE', output='OUTPUT', time='at', sequence='seq')" in capsys.readouterr().out
    # Numbers that are dates of these years are the time, in their unit, and no measurement; nor is 2.4 GHz a date.
    stamps = [f'{{"t": {1_700_000_000_000 + 500 * k}, "v": 20.{k}, "tuned": 2412000000}}' for k in range(3)]
    (tmp_path / "stamped.jsonl").write_text("\n".join(stamps))
    assert cli.main(["inspect", "stamped.jsonl"]) == 0
    said = capsys.readouterr().out
    assert "json_field('v', node='NODE', output='OUTPUT', time='t', time_unit='ms')" in said and "2 Hz" in said
    (tmp_path / "seconds.log").write_text("1700000000.25 attic 20.1\n1700000000.75 attic 20.2\n")
    assert cli.main(["inspect", "seconds.log"]) == 0 and "2 Hz" in capsys.readouterr().out
    # Of several dates the one that is not the same in all, as of Influx.
    rows = [f",,0,2026-09-27T09:00:00Z,2026-09-27T11:00:00Z,2026-09-27T10:0{k}:00Z,2{k}.1" for k in range(3)]
    (tmp_path / "flux.csv").write_text("\n".join([",result,table,_start,_stop,_time,_value", *rows, ""]))
    assert cli.main(["inspect", "flux.csv"]) == 0
    said = capsys.readouterr().out
    assert "json_field('_value', node='NODE', output='OUTPUT', time='_time')" in said and "0.0167 Hz" in said
