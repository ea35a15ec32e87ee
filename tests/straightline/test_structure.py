"""The package stands alone: it imports nothing of heliograph, and whoever uses it needs its public names alone."""

import ast
import subprocess
import sys
from pathlib import Path

import straightline

SOURCE = Path(straightline.__file__).parent


def imported(path: Path) -> set[str]:
    """First parts of the modules that a file imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.partition(".")[0])
    return names


def test_it_imports_nothing_of_heliograph():
    files = sorted(SOURCE.rglob("*.py"))
    assert len(files) > 30
    assert not [path.name for path in files if {n for n in imported(path) if n.startswith("heliograph")}]


def test_its_tests_know_nothing_of_heliograph():
    files = Path(__file__).parent.rglob("*.py")
    assert not [path.name for path in files if {n for n in imported(path) if n.startswith("heliograph")}]


def test_heliograph_takes_public_names_alone():
    taken = set()
    texts = {path: path.read_text() for path in (SOURCE.parent / "heliograph").rglob("*.py")}
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text)) if "straightline" in text else ():  # no other file can import it
            assert not isinstance(node, ast.Import) or "straightline" not in [a.name for a in node.names], path.name
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("straightline"):
                assert node.module == "straightline", f"{path.name} imports from {node.module}"
                taken |= {alias.name for alias in node.names}
    assert taken == set(straightline.__all__) - {"explain"}  # each has a use


def test_it_compiles_where_there_is_no_heliograph():
    program = """
import sys
sys.modules["heliograph"] = None  # importing it fails
import jax.numpy as jnp, numpy as np, straightline
code = straightline.compile(lambda x: jnp.sin(x) @ x, np.ones(2))
print(float(code(np.ones((3, 2)))[2]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert abs(float(done.stdout) - 1.682941969615793) < 1e-15
