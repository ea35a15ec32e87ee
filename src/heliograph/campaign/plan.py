"""What a campaign is: settings times runs, cut into chunks whose seeds depend on setting and run alone."""

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
from heliograph.numerics.readable import readable
from heliograph.simulation.draws import seed_key
from heliograph.simulation.network import Network

DIMENSIONS = ("setting", "run", "time", "node", "filter", "state", "received")
BITWISE = ("heliograph", "jax", "jaxlib", "equinox", "numpy", "zarr")  # packages that decide about the store's bytes
SETTINGS = (  # of JAX that do
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_disable_most_optimizations",
    "jax_numpy_dtype_promotion",
    "jax_threefry_partitionable",
)

Setting = dict[str, object]  # keyword arguments of the network's function, as JSON can hold them


@dataclass(frozen=True)
class Chunk:
    """Runs start..stop - 1 of one setting: what is computed, stored and retried as a whole."""

    setting: int
    number: int
    start: int
    stop: int


@readable
@dataclass(frozen=True)
class Campaign:
    """A campaign as read from its file, with the source of the network's module: all that its results depend on.

    settings: the keyword arguments of the network's function, one dictionary for each setting. inputs: by name a
    number, or one for each step. keep: "errors" or "trajectories". path: of the file. timeout: seconds that building
    a setting, or computing a chunk, may take; no result depends on it.
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
        """Names of the settings' parameters, in order of first appearance."""
        return list(dict.fromkeys(name for setting in self.settings for name in setting))

    def chunks(self, setting: int) -> list[Chunk]:
        """The chunks of one setting."""
        starts = range(0, self.runs, self.chunk)
        return [Chunk(setting, i, start, min(start + self.chunk, self.runs)) for i, start in enumerate(starts)]

    def all_chunks(self) -> Iterator[Chunk]:
        """Every chunk, setting by setting, so that a worker builds and compiles as seldom as can be."""
        for setting in range(len(self.settings)):
            yield from self.chunks(setting)

    def words(self, setting: int) -> tuple[int, int]:
        """The 64 bits that stand for a setting in its key: from its own values, so that others may come and go."""
        digest = hashlib.sha256(canonical(self.settings[setting]).encode()).digest()
        return int.from_bytes(digest[:4], "big"), int.from_bytes(digest[4:8], "big")

    def key(self, setting: int) -> jax.Array:
        """The key with which `monte_carlo` gives the runs of one setting."""
        key = seed_key(self.seed)
        for word in self.words(setting):
            key = jax.random.fold_in(key, np.uint32(word))
        return key

    def function(self) -> Callable[..., Network]:
        """The function that builds the network of a setting; loaded once in a process.

        Raises:
            ValueError: Python that does not run, or no such function. One line that names the module.
        """
        file, _, name = self.network.rpartition(":")
        return _function(str(Path(self.path).parent / file), self.source, name)

    def as_json(self) -> str:
        """The campaign as text for other processes."""
        return json.dumps(asdict(self))


def canonical(setting: Setting) -> str:
    """A setting as text that does not depend on the order of its keys."""
    return json.dumps(setting, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


@lru_cache(maxsize=8)
def from_json(text: str) -> Campaign:
    """The campaign that `as_json` wrote."""
    return Campaign(**json.loads(text))


def versions() -> dict[str, str]:
    """What decides about the store's bytes beside the campaign: packages, and how JAX is told to compute."""
    settings = {name: str(jax.config.values[name]) for name in SETTINGS}
    return _packages() | {"XLA_FLAGS": os.environ.get("XLA_FLAGS", ""), "device": jax.default_backend()} | settings


@cache
def _packages() -> dict[str, str]:
    return {name: version(name) for name in BITWISE}  # each read from a file: every job of a campaign asks


@lru_cache(maxsize=8)
def _function(path: str, source: str, name: str) -> Callable[..., Network]:
    return load_function(Path(path), source, name)
