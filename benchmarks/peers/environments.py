"""One virtual environment for each peer, under build/: their requirements conflict with ours and with each other's.

Run: python benchmarks/peers/environments.py, to make them all beforehand.
"""

import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[2] / "build" / "peers"
REQUIREMENTS = {
    "cuthbert": ("cuthbert==0.1.1",),
    "fast-kalman": ("fast-kalman==0.2.4",),
    "filterpy": ("filterpy==2.0.0",),
    "kalman-py": ("kalman-py[jax]==0.1.1",),
    "pykalman": ("pykalman==0.11.2",),
    "statsmodels": ("statsmodels==0.15.0",),
    "torch-kf": ("torch-kf==0.4.3", "torch==2.13.0", "numpy"),
}
INSTALL = ("-m", "pip", "install", "--quiet", "--quiet", "--disable-pip-version-check")
LONGEST = 600  # seconds for one environment


def python_of(peer: str) -> Path:
    """The interpreter of a peer's environment, made at its first use and when its requirements change.

    Raises:
        RuntimeError: venv or pip failed; what they said is on standard error.
    """
    folder = FOLDER / peer
    python, mark = folder / "bin" / "python", folder / "requirements.txt"
    expected = "\n".join(REQUIREMENTS[peer])
    if mark.is_file() and mark.read_text() == expected:
        return python
    print(f"making an environment for {peer} ...", file=sys.stderr)
    try:
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True, stdout=sys.stderr)
        subprocess.run([python, *INSTALL, *REQUIREMENTS[peer]], check=True, stdout=sys.stderr, timeout=LONGEST)
    except (OSError, subprocess.SubprocessError) as error:
        print(error, file=sys.stderr)
        raise RuntimeError(f"no environment for {peer}: venv or pip failed") from error
    mark.write_text(expected)
    return python


if __name__ == "__main__":
    for name in REQUIREMENTS:
        python_of(name)
