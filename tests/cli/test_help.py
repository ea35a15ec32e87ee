"""What the command does for somebody who begins: a first file, completion, hints that work, paths that do not nest."""

import re
import shutil
import subprocess
from types import SimpleNamespace

import numpy as np
import pandas
import pytest

from heliograph import cli
from heliograph.files.tables.table import read_table


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_new_network_says_what_to_do_next(folder, capsys):
    assert cli.main(["new", "cart.py"]) == 0
    assert capsys.readouterr().out == "cart.py: next, python cart.py\n"
    text = (folder / "cart.py").read_text()
    assert "heliograph run cart.py --measurements data.csv --report report" in text and "my_network" not in text
    compile(text, "cart.py", "exec")  # tests/test_readme.py runs it


@pytest.mark.parametrize(
    ("name", "words"), [("there.py", "a new name"), ("no/x.py", "an existing folder"), ("x.txt", "ends in .py")]
)
def test_a_new_network_takes_nobodys_place(folder, capsys, name, words):
    (folder / "there.py").write_text("mine")
    assert cli.main(["new", name]) == 2 and words in capsys.readouterr().err
    assert (folder / "there.py").read_text() == "mine" and len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete(capsys, shell):
    assert cli.main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(word in script for word in ("reproduce", "example", "measurements", "report"))
    if shutil.which(shell):
        assert subprocess.run([shell, "-n"], input=script, text=True).returncode == 0


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_a_word(capsys):
    assert cli.main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    name = re.search(r"complete .*-F (\w+) ", script)[1]
    requested = "COMP_WORDS=(heliograph rep); COMP_CWORD=1; COMP_LINE='heliograph rep'; COMP_POINT=14"
    ask = f"{requested}; {name}; echo ${{COMPREPLY[@]}}"
    done = subprocess.run(["bash", "-c", f"{script}\n{ask}"], capture_output=True, text=True)
    assert "reproduce" in done.stdout.split()


@pytest.mark.parametrize(("out", "expected"), [("out", "out"), ("out/uwb", "out"), ("uwb", ".")])
def test_results_are_not_put_one_folder_deeper_than_said(monkeypatch, out, expected):
    calls = []
    study = SimpleNamespace(settings=lambda values: values, run=lambda setting, place: calls.append(str(place)))
    monkeypatch.setattr("heliograph.cli.studies.load_study", lambda entry: study)
    assert cli.main(["example", "uwb", "--out", out]) == 0 and calls == [expected]
    assert cli.main(["reproduce", "quadratic-bias", "--out", out.replace("uwb", "quadratic-bias")]) == 0
    assert calls[1] == expected
    assert cli.main(["reproduce", "all", "--out", "out/all"]) == 0 and set(calls[2:]) == {"out/all"}


@pytest.mark.parametrize(
    "text",
    [
        "time;pos\n0.5;1.5\n",
        "time;pos\n0,5;1,5\n",
        "time\tpos\n0.5\t1.5\n",
        "time|pos\n0.5|1.5\n",
        "time pos\n0.5 1.5\n",
        'time,pos\n"0,5","1,5"\n',
        "# a drive\ntime,pos\n0.5,1.5\n",
        "time,pos\n# a pause\n0.5,1.5\n",
    ],
)
def test_a_hint_is_a_remedy(folder, text):
    """Whatever it says to do is done here, and the table then is one."""
    (folder / "data.csv").write_text(text)
    with pytest.raises(ValueError) as raised:
        read_table("data.csv")
    remedy = re.search(r": (pandas.*) rewrites it$", str(raised.value))[1]
    exec(remedy, {"pandas": pandas})
    np.testing.assert_array_equal(read_table("data.csv")["pos"], [1.5])
    np.testing.assert_array_equal(read_table("data.csv")["time"], [0.5])


@pytest.mark.parametrize("word", ["NA", "#N/A", "null", "None", "-", "-nan(ind)", "1.#QNAN", "NaN"])
def test_a_word_for_nothing_is_an_empty_cell(folder, word):
    (folder / "data.csv").write_text(f"time,pos\n0,{word}\n1,2\n")
    np.testing.assert_array_equal(read_table("data.csv")["pos"], [np.nan, 2])
