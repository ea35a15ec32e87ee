"""Lines with estimates that fill a template are, byte for byte, those that are written filter by filter."""

import json

import numpy as np
import pytest
from pydantic_core import to_json

import heliograph as hg
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving.estimate_writer import EstimateWriter
from tests.losing import Losing
from tests.serving.worlds import fleet, stepping


def stepped() -> NetworkProgram:
    return fleet(stepping()).program


def weighed() -> NetworkProgram:
    """A filter that weighs its two numbers, one that claims nothing, and names full of signs."""
    plant = hg.LinearPlant(0.9 * np.eye(2), 0.1, [0.0, 0.0], 1.0, states=["p", "v"])
    both, position = hg.LinearSensor(np.eye(2), 0.1), hg.LinearSensor([[1.0, 0.0]], 0.1)
    robust = hg.robust_filter(plant, both, hg.perfect(2), hg.filters.Gate(30.0))
    nodes = {'a "%d"': hg.Node(both, hg.perfect(2), {"100 %b": robust})}
    return NetworkProgram(
        hg.Network(plant, nodes | {"b": hg.Node(position, hg.perfect(), {"level": Losing(claim="none")})})
    )


@pytest.mark.parametrize("program", [stepped, pytest.param(weighed, marks=pytest.mark.slow)])
def test_a_line_from_the_template_is_that_of_its_row(program):
    generator = np.random.default_rng(0)
    program = program()
    writer, size = EstimateWriter(program), program.step_rows.outputs.size
    # Plain rows, rows with a number that is none, and rows with one that is negative or raises a flag.
    outputs = np.abs(generator.normal(size=(300, size))) * 10.0 ** generator.integers(-30, 30, (300, size))
    for row in outputs[100:]:
        row[generator.integers(size)] = generator.choice([np.nan, np.inf, -1.0])
    counts = [i for columns in program.filter_columns for i in (columns.judgement or columns.tested or ())[1:2]]
    outputs[:, counts] = generator.integers(0, 3, (300, len(counts)))
    reasons = [columns.judgement.reason for columns in program.filter_columns if columns.judgement is not None]
    outputs[:, reasons] = 2 * generator.integers(0, 2, (300, len(reasons))) * (np.arange(300)[:, None] >= 200)
    rows = [(f'p{i}, "%b"', float(i) if i % 3 else "2026-11-26T00:00:00+00:00") for i in range(300)]
    written = writer.write_lines(b"final", rows, outputs)
    for (plant, moment), row, body in zip(rows, outputs.tolist(), written, strict=True):
        head = b'{"kind":"final","plant":%b,"time":%b,"estimates":' % (to_json(plant), to_json(moment))
        assert body == head + to_json(writer._write_estimates(row), inf_nan_mode="null") + b"}"
        assert json.loads(body)["plant"] == plant
    assert writer.write_lines(b"final", [], outputs[:0]) == []
