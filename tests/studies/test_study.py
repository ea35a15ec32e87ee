"""A study: other numbers, what is kept of one that fails, what is written, and what is printed."""

import json
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies.outcome import Inline, Unlisted, summary
from heliograph_studies.settings import differences, digest, leaves, with_values
from heliograph_studies.stages import Stages
from heliograph_studies.statement import Statement, holds
from heliograph_studies.study import Study

PAGE = """
{% set half = 0.5 * total %}
A study

# It is {{ total | fmt(".2f") }}

Lead of {{ setting.noise.mean }}.

## Table

| name | value |
|---|--:|
{% for name, value in parts.items() %}
| #0072b2 {{ name }} | {{ value }} |
{% endfor %}

: A caption that goes
on.

```keys
#0072b2 | half | {{ half }} m | of the total
```

```statements
paper
```

```sh
{{ command }}
```

---

The end.
"""


@dataclass(frozen=True)
class Noise:
    mean: float = 0.0
    values: tuple[float, ...] = (1.0, 2.0)
    pairs: tuple[tuple[int, int], ...] = ((1, 2), (3, 4))
    law: hg.Discrete = field(default_factory=lambda: hg.Discrete([1.0], [1.0]))


@dataclass(frozen=True)
class Setting:
    runs: int = 10
    seed: int = 0
    name: str = "a"
    exact: bool = True
    noise: Noise = Noise()
    plant: hg.LinearPlant | None = None
    matrix: np.ndarray | None = None


@dataclass(frozen=True)
class Part:
    inner: float


@dataclass(frozen=True)
class Outcome:
    parts: dict[str, float]
    total: np.float64
    raw: Unlisted[np.ndarray]
    part: Inline[Part]


calls: list[str] = []


def compute(setting: Setting, stages: Stages) -> Outcome:
    def first() -> np.ndarray:
        calls.append("first")
        return np.array([1.0, setting.noise.mean])

    def second() -> float:
        calls.append("second")
        if setting.name == "broken":
            raise ArithmeticError("no\nnumber")
        return 2.0

    values = stages("The first", first)
    return Outcome({"a": 1.0, "b": stages("the second", second)}, values.sum(), values, Part(3.0))


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    judged = Statement("it is large", "(1)", "", f"{outcome.total}", {"total": float(outcome.total)},
                       lambda total: holds(total > 2))  # fmt: skip
    return {"paper": [judged]}


def words(outcome: Outcome) -> dict[str, object]:
    return {}


@pytest.fixture
def study(tmp_path, monkeypatch):
    calls.clear()
    (tmp_path / "page.md").write_text(PAGE)
    monkeypatch.setattr("heliograph_studies.study.inspect.getfile", lambda function: str(tmp_path / "compute.py"))
    (tmp_path / "compute.py").write_text("")
    return Study("number", Setting, compute, 2, lambda outcome: {}, words, "A paper on numbers", statements)


def test_other_numbers_by_name():
    setting = with_values(
        Setting(), {"noise.mean": "0.3", "seed": "4", "exact": "false", "noise.values": "3,4", "noise.pairs": "1,1,2,2"}
    )
    assert (setting.seed, setting.exact, setting.noise.mean, setting.noise.values) == (4, False, 0.3, (3.0, 4.0))
    assert setting.noise.pairs == ((1, 1), (2, 2))
    assert dict(leaves(setting))["noise.values"] == (3.0, 4.0)
    law = with_values(Setting(), {"noise.law.values": "2"}).noise.law
    np.testing.assert_array_equal(law.values, [2.0])
    moved = with_values(Setting(matrix=np.eye(2)), {"matrix": "1,2,3,4"})
    np.testing.assert_array_equal(moved.matrix, [[1.0, 2.0], [3.0, 4.0]])


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("noise.maen", "1", r"--set: expected one of runs, seed, .*noise\.mean.*, got 'noise\.maen'"),
        ("noise", "1", "--set noise: expected a number; what is none is set in Python, got '1'"),
        ("noise.mean.x", "1", "--set: expected one of runs"),
        ("noise.mean", "much", "--set noise.mean: expected a number, got 'much'"),
        ("runs", "1.5", "--set runs: expected a whole number, got '1.5'"),
        ("exact", "yes", "--set exact: expected true or false, got 'yes'"),
        ("noise.values", "1", "--set noise.values: expected 2 numbers separated by commas, got '1'"),
        ("noise.values", "1,x", "--set noise.values: expected 2 numbers separated by commas, got '1,x'"),
        ("noise.pairs", "1,2,3,4.5", "--set noise.pairs: expected 4 numbers separated by commas, got '1,2,3,4.5'"),
        ("plant", "1", "--set plant: expected a number; what is none is set in Python, got '1'"),
    ],
)
def test_bad_numbers_are_refused_in_a_line(name, text, words):
    with pytest.raises(ValueError, match=words) as refused:
        with_values(Setting(), {name: text})
    assert "\n" not in str(refused.value)


def test_an_object_that_is_made_of_other_arguments_than_it_holds_is_set_in_python():
    plant = hg.LinearPlant([[0.5]], [[1.0]], [0.0], [[1.0]])
    with pytest.raises(ValueError, match=r"--set plant\.matrix: expected a LinearPlant that is set in Python, got '2'"):
        with_values(Setting(plant=plant), {"plant.matrix": "2"})


def test_what_tells_settings_apart():
    plant = hg.LinearPlant([[0.5]], [[1.0]], [0.0], [[1.0]])
    assert differences(Setting(), Setting()) == {}
    changed = differences(Setting(plant=plant, noise=Noise(0.3)), Setting())
    assert changed["noise.mean"] == ("0", "0.3") and all(name.startswith(("noise", "plant")) for name in changed)
    assert digest(Setting()) == digest(Setting()) != digest(Setting(seed=1))
    same = hg.LinearPlant([[0.5]], [[1.0]], [0.0], [[1.0]])
    other = hg.LinearPlant([[0.6]], [[1.0]], [0.0], [[1.0]])
    assert digest(Setting(plant=plant)) == digest(Setting(plant=same)) != digest(Setting(plant=other))
    moving = hg.Plant(lambda x, u: x, [[1.0]], [0.0], [[1.0]], ["x"])
    assert digest(Setting(plant=moving)) is None  # nothing tells one function in it from another


def test_the_summary_is_the_outcome():
    result = summary(Outcome({"a": 1.0}, np.float64(2.0), np.zeros(2), Part(3.0)))
    assert result == {"parts": {"a": 1.0}, "total": 2.0, "inner": 3.0} and type(result["total"]) is float
    assert summary({0.5: (np.arange(2), None, True), 3: Part(np.float64(1))}) == {
        "0.5": [[0, 1], None, True],
        "3": {"inner": 1.0},
    }


def test_it_is_written_and_said(study, tmp_path, capsys):
    outcome = study.run(Setting(noise=Noise(0.3)), tmp_path / "out")
    folder = tmp_path / "out" / "number"
    assert outcome.total == 1.3
    summary_ = json.loads((folder / "summary.json").read_text())
    assert summary_["paper"] == "A paper on numbers" and summary_["total"] == 1.3 and summary_["inner"] == 3.0
    assert summary_["changed"] == {"noise.mean": {"there": "0", "here": "0.3"}} and "raw" not in summary_
    assert summary_["claims"][0]["verdict"] == "fails"
    html = (folder / "report.html").read_text().partition("<body>")[2]
    order = ["A study", "It is 1.30", "Lead of 0.3.", "What differs from the publication", "<code>noise.mean</code>",
             "A caption that goes on.", "0.65", "of 1 statement of the paper <strong>1 fails</strong>", "it is large",
             "heliograph reproduce number --out out --runs 10 --seed 0 --set noise.mean=0.3", "The end."]  # fmt: skip
    assert [html.index(text) for text in order] == sorted(html.index(text) for text in order)
    assert capsys.readouterr().out.splitlines() == [
        "It is 1.30",
        "- half: 0.65 m (of the total)",
        "Judged by this run: of 1 statement of the paper 1 fails.",
        f"Report: {folder / 'report.html'}",
    ]
    assert not (tmp_path / "out" / "number.stages").exists()


def test_as_published_nothing_differs_and_nothing_is_written_without_a_folder(study, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    outcome = study.run()
    assert outcome.total == 1.0 and set(tmp_path.iterdir()) == before
    page = study.make_page(Setting(runs=3), outcome, study.statements(outcome), {})
    assert [section.title for section in page.sections] == ["Table"]


def test_a_package_that_is_missing_is_said_before_the_work_starts(study, tmp_path):
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        replace(study, needs=["no_such_package"]).run(Setting(), out=tmp_path / "out")
    assert not calls and not (tmp_path / "out").exists()


def test_a_study_that_fails_keeps_its_stages(study, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(
        ValueError, match="number, the second: expected to be worked out, got ArithmeticError: no number;"
    ) as failed:
        study.run(Setting(name="broken"), out)
    assert f"kept in {out / 'number.stages'}" in str(failed.value) and "\n" not in str(failed.value)
    assert calls == ["first", "second"] and not (out / "number").exists()
    with pytest.raises(ValueError, match="the second"):
        study.run(Setting(name="broken"), out)
    assert calls == ["first", "second", "second"]  # what was done is not done again
    study.run(Setting(), out)  # another setting's stages are not its own
    assert calls[3:] == ["first", "second"] and (out / "number" / "summary.json").is_file()


def test_what_cannot_be_drawn_fails_in_a_line_and_keeps_everything(study, tmp_path):
    unseen = replace(study, figures=lambda outcome: {"a": 1 / 0})
    with pytest.raises(ValueError, match=r"number, drawing and writing: .*ZeroDivisionError.*kept in .*number\.stages"):
        unseen.run(Setting(), tmp_path)
    study.run(Setting(), tmp_path)
    assert calls == ["first", "second"]


@pytest.mark.parametrize("change", ["code", "file", "recording"])
def test_stages_of_other_code_or_data_or_broken_ones_are_done_again(study, tmp_path, change):
    recording = tmp_path / "recording.csv"
    recording.write_text("1,2")
    study = replace(study, files=lambda setting: [recording])
    with pytest.raises(ValueError):
        study.run(Setting(name="broken"), tmp_path)
    if change == "code":
        (tmp_path / "compute.py").write_text("# repaired")
    elif change == "recording":
        recording.write_text("1,3")
    else:
        (path,) = (tmp_path / "number.stages").glob("*.pickle")
        path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(ValueError):
        study.run(Setting(name="broken"), tmp_path)
    assert calls == ["first", "second"] * 2


def test_a_page_that_names_what_is_not_there(study, tmp_path):
    (tmp_path / "page.md").write_text("# {{ totl }}")
    with pytest.raises(
        ValueError, match=r"page .*page.md: expected a template of what was found, got 'totl' is undefined"
    ):
        study.run(Setting(), tmp_path / "out")
    assert not (tmp_path / "out" / "number").exists()
