"""Plan of a campaign: settings times runs, cut into chunks whose random keys depend on setting and run alone."""

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from heliograph.files.network_file import load_function
from heliograph.numerics.module import readable
from heliograph.numerics.random_keys import seed_key
from heliograph.simulation.network import Network

DIMENSIONS = ("setting", "run", "time", "node", "filter", "state", "received")
BITWISE = ("heliograph", "jax", "jaxlib", "equinox", "numpy", "zarr")  # packages that decide about the store's bytes
SETTINGS = (  # settings of JAX that decide about them too
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_disable_most_optimizations",
    "jax_numpy_dtype_promotion",
    "jax_threefry_partitionable",
)

Setting = dict[str, object]  # keyword arguments of the network's function, as JSON can hold them


@dataclass(frozen=True)
class Chunk:
    """Runs start..stop - 1 of one setting: what is computed, stored and repeated as a whole."""

    setting: int
    number: int
    start: int
    stop: int


@readable
@dataclass(frozen=True)
class Campaign:
    """A campaign as read from its file, with everything that its results depend on.

    Args:
        text: the text of the campaign's file.
        network: name of the function that builds the network, as in the file.
        source: source code of the network's module.
        path: absolute path of the file.
        horizon: number of steps of each run.
        runs: number of runs of each setting.
        seed: seed of the random key.
        chunk: number of runs that are computed and stored together.
        keep: "errors" or "trajectories": what the store has of each run.
        inputs: the plant's inputs by name, each a number or a list with one number for each step.
        settings: keyword arguments of the network's function, one dictionary for each setting.
        timeout: seconds that building a setting, or computing a chunk, may take; no result depends on it.
        versions: versions of packages and settings of JAX that the stored bytes depend on.
    """

    text: str
    network: str
    source: str
    path: str
    horizon: int
    runs: int
    seed: int
    chunk: int
    keep: str
    inputs: dict[str, float | list[float]]
    settings: list[Setting]
    timeout: float
    versions: dict[str, str]

    @property
    def parameters(self) -> list[str]:
        """Return the names of the settings' parameters, in order of first appearance."""
        return list(dict.fromkeys(name for setting in self.settings for name in setting))

    def chunks(self, setting: int) -> list[Chunk]:
        """Return the chunks of one setting."""
        starts = range(0, self.runs, self.chunk)
        return [Chunk(setting, i, start, min(start + self.chunk, self.runs)) for i, start in enumerate(starts)]

    def all_chunks(self) -> Iterator[Chunk]:
        """Return every chunk, setting by setting, so that a worker builds and compiles as rarely as possible."""
        for setting in range(len(self.settings)):
            yield from self.chunks(setting)

    def words(self, setting: int) -> tuple[int, int]:
        """Return the two 32-bit words that stand for a setting in its random key: the first of a hash of its values.

        Other settings can therefore be added or removed without changing this setting's runs.
        """
        digest = hashlib.sha256(serialise_setting(self.settings[setting]).encode()).digest()
        return int.from_bytes(digest[:4], "big"), int.from_bytes(digest[4:8], "big")

    def key(self, setting: int) -> jax.Array:
        """Return the random key with which `monte_carlo` simulates one setting: the seed with the setting's words."""
        key = seed_key(self.seed)
        for word in self.words(setting):
            key = jax.random.fold_in(key, np.uint32(word))
        return key

    def function(self) -> Callable[..., Network]:
        """Return the function that builds a setting's network from its parameters; loaded once in a process."""
        file, _, name = self.network.rpartition(":")
        return _load_function_once(str(Path(self.path).parent / file), self.source, name)

    def as_json(self) -> str:
        """Serialise the campaign for other processes."""
        return json.dumps(asdict(self))


def serialise_setting(setting: Setting) -> str:
    """Serialise a setting as text that does not depend on the order of its keys."""
    return json.dumps(setting, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


@lru_cache(maxsize=8)
def parse_campaign(text: str) -> Campaign:
    """Restore a campaign from the text of `as_json`."""
    return Campaign(**json.loads(text))


def collect_versions() -> dict[str, str]:
    """Return what the stored results depend on to the bit, besides the campaign itself, by name.

    That is the versions of packages, and of JAX its settings, the flags of its compiler, and the kind of device.
    """
    settings = {name: str(jax.config.values[name]) for name in SETTINGS}
    return _list_versions() | {"XLA_FLAGS": os.environ.get("XLA_FLAGS", ""), "device": jax.default_backend()} | settings


@cache
def _list_versions() -> dict[str, str]:
    """Return the versions of packages; kept, since every job of a campaign asks and each is read from a file."""
    return {name: version(name) for name in BITWISE}


@lru_cache(maxsize=8)
def _load_function_once(path: str, source: str, name: str) -> Callable[..., Network]:
    """Return the function of a name in a file's source, which runs only once in a process."""
    return load_function(Path(path), source, name)
