"""A conda channel of stand-ins, made of what this interpreter has: a build needs no other, and no network."""

import ensurepip
import hashlib
import json
import platform
import shutil
import sys
import zipfile
from collections.abc import Sequence
from importlib.metadata import distribution
from pathlib import Path

SUBDIR = {"x86_64": "linux-64", "aarch64": "linux-aarch64"}[platform.machine()]
SHORT = f"python{sys.version_info[0]}.{sys.version_info[1]}"
SITE = Path("lib") / SHORT / "site-packages"
BUILD = ("hatchling", "pathspec", "pluggy", "packaging", "trove-classifiers")  # the backend, and what it imports


class Channel:
    """A folder that rattler-build takes for a channel: `python` of this one's base, `pip` of its bundle, `hatchling`.

    What the package runs with are packages of the right name and version that lead to this interpreter's own.
    """

    def __init__(self, folder: Path, run: Sequence[str]) -> None:
        self.folder, self._staged = folder / "channel", folder / "staged"
        self.packages: dict[str, dict[str, object]] = {}
        for subdir in (SUBDIR, "noarch"):
            (self.folder / subdir).mkdir(parents=True)
        self._add_python()
        bundled = next((Path(ensurepip.__file__).parent / "_bundled").glob("pip-*.whl"))
        with zipfile.ZipFile(bundled) as wheel:
            wheel.extractall(self._stage("pip") / SITE)
        self._assemble("pip", bundled.name.split("-")[1])
        for name in BUILD:
            _copy_distribution(name, self._stage("hatchling") / SITE)
        self._assemble("hatchling", distribution("hatchling").version)
        for name in run:
            site = self._stage(name) / SITE
            site.mkdir(parents=True)
            (site / f"{name}_at_hand.pth").write_text(f"{Path(str(distribution(name).locate_file('')))}\n")
            self._assemble(name, distribution(name).version)
        index = {"packages": {}, "packages.conda": self.packages, "repodata_version": 1}
        for subdir in (SUBDIR, "noarch"):
            kept = index if subdir == SUBDIR else index | {"packages.conda": {}}
            (self.folder / subdir / "repodata.json").write_text(json.dumps(kept | {"info": {"subdir": subdir}}))

    @property
    def url(self) -> str:
        """Where it is."""
        return self.folder.as_uri()

    def _stage(self, name: str) -> Path:
        return self._staged / name

    def _add_python(self) -> None:
        """An environment of this interpreter's base, as `venv` makes one: prefix and packages are the folder's own."""
        root, base = self._stage("python"), Path(sys.base_prefix) / "bin" / SHORT
        (root / "bin").mkdir(parents=True)
        (root / SITE).mkdir(parents=True)
        for name in ("python", "python3", SHORT):
            (root / "bin" / name).symlink_to(base)
        (root / "pyvenv.cfg").write_text(f"home = {base.parent}\ninclude-system-site-packages = false\n")
        self._assemble("python", platform.python_version(), depends=[])

    def _assemble(self, name: str, version: str, depends: Sequence[str] = ("python",)) -> None:
        """Make the package of a staged folder, and its entry in the index."""
        from rattler_build import assemble_package

        made = assemble_package(
            name=name, version=version, target_platform=SUBDIR, build_string="0", depends=list(depends),
            output_dir=self.folder / SUBDIR, files_dir=self._stage(name), detect_prefix=False,
        )  # fmt: skip
        content = Path(made.path).read_bytes()
        self.packages[Path(made.path).name] = {
            "name": name, "version": version, "build": "0", "build_number": 0, "depends": list(depends),
            "subdir": SUBDIR, "size": len(content), "sha256": hashlib.sha256(content).hexdigest(),
        }  # fmt: skip


def _copy_distribution(name: str, site: Path) -> None:
    """Copy what a distribution installed among the packages."""
    known = distribution(name)
    for file in known.files or ():
        source = Path(str(known.locate_file(file)))
        if ".." not in file.parts and "__pycache__" not in file.parts and source.is_file():
            (site / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, site / file)
