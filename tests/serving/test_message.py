"""Messages that are decoded quickly are those that pydantic reads, and all others are refused in the same words."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph.serving.message import Message, NumberedMessage, UnreadMessage, read_message, read_messages

FIELDS = {"node": '"a"', "sequence": "1", "time": "1"}
VALUES = (
    *("1", "1.0", "-1", "1e2", "-0", "-0.0", "true", "null", "NaN", "-Infinity", "1e400", "1e-400", "01", "1.", "[]"),
    *("9223372036854775807", "9223372036854775808", "1" * 30, "0." + "1" * 700, "[1, null, 2.5]", "[true]", '["1"]'),
    *("{}", "[1,]", "[[1]]", "[1e999]", '"2026-11-21T23:25:00Z"', '"2026-11-21 23:25"', '"x"', '""', '"\\u0000"'),
    *('"\\ud800"', '"1"', '"\\ud83d\\ude00"', '"' + "é" * 200 + '"', '"' + "é" * 201 + '"', '"a\tb"', '"a\\tb"'),
    *("[" * 2000, ""),
)  # fmt: skip


def by_pydantic(payload: bytes) -> Message | str:
    try:
        return read_message(payload)
    except hg.InputError as error:
        return str(error)


@pytest.mark.parametrize("field", ["plant", "node", "sequence", "time", "values", "inputs", "arrival", "more"])
def test_a_line_is_read_or_refused_as_pydantic_does(field):
    quick = 0
    for value in VALUES:
        fields = FIELDS | {field: value}
        text = ", ".join(f'"{name}": {part}' for name, part in fields.items())
        for payload in (f"{{{text}}}", f" {{{text}, {text}}} \r", f"{{{text}}} x", f"[{text}]"):
            payload = payload.encode()
            # Whatever the first line is, which decides whether the quick way is tried.
            for first in (b'{"node": "a", "sequence": 1, "time": 1}', b'{"node": "a", "sequence": 1, "time": "x"}'):
                _, read = read_messages([first, payload])
                expected = by_pydantic(payload)
                assert isinstance(read, str | UnreadMessage) == isinstance(expected, str)
                if isinstance(read, UnreadMessage):
                    assert (read.why, read.read.node, read.read.sequence) == (expected, "a", 1)
                    continue
                if isinstance(read, str):
                    assert read == expected
                    continue
                quick += isinstance(read, NumberedMessage)
                for name in Message.model_fields:
                    got = getattr(read, name)
                    assert got == getattr(expected, name) and type(got) is type(getattr(expected, name))
    assert quick or field == "more"


def test_bytes_that_are_no_text_and_lines_that_are_too_long_are_refused():
    line = b'{"node": "a", "sequence": 1, "time": 1, "plant": "\xff"}'
    long = b'{"node": "a", "sequence": 1, "time": 1, "values": [' + b" " * (1 << 20) + b"]}"
    assert read_messages([line, long, "a reason"]) == [by_pydantic(line), by_pydantic(long), "a reason"]


DOUBLED = (
    ('{"node": "a", "sequence": 1, "time": 1, "values": [20], "values": [30]}', "values", True),
    ('{"node":"a","sequence":1,"time":1,"values":[20],"v\\u0061lues":[30]}', "values", True),
    ('{"plant": "values", "node": "a", "sequence": 1, "time": 1, "inputs": null, "inputs": [2]}', "inputs", True),
    ('{"node": "a", "sequence": 1, "time": "2026-11-21T23:25:00Z", "values": [], "values": [1]}', "values", True),
    ('{"node": "a", "sequence": 1, "sequence": 2, "time": 1, "values": [20]}', "sequence", False),
    ('{"node": "b", "node": "a", "sequence": 1, "time": 1}', "node", False),
)


@pytest.mark.parametrize(("line", "field", "named"), DOUBLED)
def test_a_field_that_is_there_twice_is_refused(line, field, named):
    """Of which decoders use the last; the message is named by its node and count, unless one of these is doubled."""
    (read,) = read_messages([line.encode()])
    why = f"message: expected distinct fields, got {field!r} more than once"
    assert (read.why, read.read.node, read.read.sequence) == (why, "a", 1) if named else read == why
    with pytest.raises(hg.InputError, match=why):
        read_message(line.encode())


def test_names_of_fields_in_texts_double_nothing():
    line = '{"plant": "\\"values\\"", "node": "values", "sequence": 1, "time": 1.5, "values": [], "inputs": null}'
    (read,) = read_messages([line.encode()])
    assert isinstance(read, NumberedMessage) and (read.plant, read.node) == ('"values"', "values")


def test_numbers_are_read_to_the_last_bit():
    generator = np.random.default_rng(0)
    bits = generator.integers(0, 2**63, 5_000).view(np.float64)
    numbers = bits[np.isfinite(bits)].tolist()
    texts = [f"{number:.{digits}e}" for number in numbers for digits in (15, 16, 17, 25)]
    texts += map(repr, numbers)
    payload = f'{{"node": "a", "sequence": 1, "time": 1, "values": [{", ".join(texts)}]}}'.encode()
    (read,) = read_messages([payload])
    assert isinstance(read, NumberedMessage) and read.values == [*map(float, texts)] == json.loads(payload)["values"]
