"""What is free in a network: numbers marked where they stand, and the network built again with others there."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, Protocol, get_args

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from heliograph.learning.transforms import from_line, size, slope, to_line, unlink, unlink_slope
from heliograph.numerics.check import array, fail, function, instance, shown, shown_error
from heliograph.numerics.domain import COVARIANCE, POSITIVE, PROBABILITY, REAL, SIMPLEX, Domain, marked
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.simulation.network import Network

Kind = Literal["real", "positive", "probability", "simplex", "covariance"]
Build = Callable[[], Network]

DOMAINS: dict[Kind, Domain] = {
    "real": REAL,
    "positive": POSITIVE,
    "probability": PROBABILITY,
    "simplex": SIMPLEX,
    "covariance": COVARIANCE,
}


def free(start: ArrayLike, name: str | None = None, kind: Kind | None = None) -> Any:
    """Mark a number of a network as one to be learned, from `start`; it stands wherever the number itself would.

    `hg.hop(hg.Rayleigh(hg.free(0.8, "fading")), noise=hg.free(0.3))`, inside a function that returns the network and
    that `hg.fit` calls. One name in several places is one number. Where it stands says what it is: a variance and a
    scale stay positive, a probability between 0 and 1, probabilities sum to 1, a covariance matrix stays one; a gain,
    an entry of a matrix, a number in a function of your own may be any, unless `kind` says otherwise. Without a name it
    is called after its place. Anywhere else than in a fit it is its start.

    Shapes: start () or of any shape; kind "simplex" sums over the last axis.

    Raises:
        ValueError: a start that is no number, or an unknown kind.
    """
    if kind is not None and kind not in get_args(Kind):
        raise fail("kind of a free number", f"one of {', '.join(get_args(Kind))}", shown(kind))
    if name is not None and (not isinstance(name, str) or not name):
        raise fail("name of a free number", "a text", shown(name))
    what = "free number" if name is None else name
    value = array(f"start of {what}", start, (None,) * np.ndim(np.asarray(start)))
    reader = _reader.get()
    return (value if value.ndim else float(value)) if reader is None else reader.read(value, name, kind)


class _Reader(Protocol):
    def read(self, start: np.ndarray, name: str | None, kind: Kind | None) -> Any: ...


# What `free` answers depends on who builds the network: nobody, one who asks what is free, or one who tries values.
_reader: ContextVar[_Reader | None] = ContextVar("reader of free numbers", default=None)


@contextmanager
def _reading(reader: _Reader) -> Iterator[None]:
    token = _reader.set(reader)
    try:
        yield
    finally:
        _reader.reset(token)


@readable
@dataclass(frozen=True)
class Parameter:
    """A free number: its name, start, domain, and whether the user gave the name."""

    name: str
    start: Float[np.ndarray, "..."]
    domain: Domain

    @property
    def size(self) -> int:
        """Numbers on the line."""
        return size(self.domain, self.start.shape)

    @property
    def entries(self) -> tuple[str, ...]:
        """Names of its entries, of a covariance those on and below the diagonal."""
        if self.start.ndim == 0:
            return (self.name,)
        places = [at for at in np.ndindex(self.start.shape) if self.domain.kind != "covariance" or at[0] >= at[1]]
        return tuple(f"{self.name}[{','.join(map(str, at))}]" for at in places)

    def read(self, value: Array) -> Array:
        """Those entries as a vector."""
        return value[np.tril_indices(len(value))] if self.domain.kind == "covariance" else value.reshape(-1)

    def values(self, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, " entries"]:
        """The entries at a point of the line."""
        if self.domain.kind == "interval":
            return np.asarray(unlink(self.domain, x))
        with jax.enable_x64(True):
            return np.asarray(self._read_at(jnp.asarray(x)))

    def derivatives(self, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, "entries size"]:
        """Their derivatives."""
        if self.domain.kind == "interval":
            return np.diag(unlink_slope(self.domain, x))
        with jax.enable_x64(True):
            return np.asarray(jax.jacfwd(self._read_at)(jnp.asarray(x)))

    def _read_at(self, x: Array) -> Array:
        return self.read(from_line(self.domain, self.start.shape, x))

    @property
    def entry_domains(self) -> tuple[Domain, ...]:
        """Where each entry may lie."""
        if self.domain.kind == "simplex":
            return (PROBABILITY,) * self.start.size
        if self.domain.kind == "covariance":
            return tuple(POSITIVE if i == j else REAL for i, j in zip(*np.tril_indices(len(self.start)), strict=True))
        return (self.domain,) * self.start.size


class Entry(NamedTuple):
    """A number of the table: its name, where it may lie, and, if it has one of its own, its place on the line."""

    name: str
    domain: Domain
    place: int | None


@readable
@dataclass(frozen=True)
class Parameters:
    """All free numbers of a network in the order in which it asks for them."""

    every: tuple[Parameter, ...]

    @property
    def size(self) -> int:
        """Numbers on the line."""
        return sum(one.size for one in self.every)

    @property
    def start(self) -> Float[np.ndarray, " p"]:
        """The starts on the line."""
        return np.concatenate([to_line(one.name, one.domain, one.start) for one in self.every])

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The rows of the table."""
        found, begin = [], 0
        for one in self.every:
            own = one.domain.kind == "interval"
            for i, (name, domain) in enumerate(zip(one.entries, one.entry_domains, strict=True)):
                found.append(Entry(name, domain, begin + i if own else None))
            begin += one.size
        return tuple(found)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the numbers on the line."""
        return tuple(
            one.entries[i] if one.domain.kind == "interval" else f"{one.name}({i})"
            for one in self.every
            for i in range(one.size)
        )

    def values(self, x: Array) -> dict[str, Array]:
        """The numbers at a point of the line, by name."""
        ends = np.cumsum([0, *(one.size for one in self.every)])
        return {
            one.name: from_line(one.domain, one.start.shape, x[a:b])
            for one, a, b in zip(self.every, ends[:-1], ends[1:], strict=True)
        }

    def known(self, x: Float[np.ndarray, " p"]) -> dict[str, Any]:
        """The same as plain numbers and arrays."""
        with jax.enable_x64(True):
            return {name: plain_number(value) for name, value in self.values(jnp.asarray(x)).items()}

    def entries_at(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " entries"]:
        """Values of the entries."""
        return np.concatenate([one.values(own) for one, own in self._parts(x)])

    def jacobian(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, "entries p"]:
        """Derivatives of the entries."""
        return np.asarray(block_diag(*(one.derivatives(own) for one, own in self._parts(x))))

    def _parts(self, x: np.ndarray) -> list[tuple[Parameter, np.ndarray]]:
        ends = np.cumsum([one.size for one in self.every])
        return list(zip(self.every, np.split(x, ends[:-1]), strict=True))

    def slopes(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, "entries p"]:
        """Derivatives of the entries, each on the scale where its interval is symmetric."""
        pairs = zip(self.entries, self.entries_at(x), self.jacobian(x), strict=True)
        with np.errstate(all="ignore"):
            return np.stack([slope(entry.domain, value) * row for entry, value, row in pairs])


class _Mark:
    """A free number while it is being asked for."""

    def __init__(self, start: np.ndarray, name: str | None, kind: Kind | None):
        self.start, self.given, self.place = start, name, ""
        self.domain = None if kind is None else DOMAINS[kind]
        self.explicit = kind is not None

    def told(self, name: str, domain: Domain) -> None:
        """A check says what it is: the narrowest holds."""
        self.place = self.place or name
        if self.explicit:
            return
        known = REAL if self.domain is None else self.domain
        if known.kind == domain.kind == "interval":
            domain = Domain(low=max(known.low, domain.low), high=min(known.high, domain.high))
        elif domain == REAL:
            domain = known
        self.domain = domain


class _Asking:
    """Collects what is free."""

    def __init__(self) -> None:
        self.marks: list[_Mark] = []

    def read(self, start: np.ndarray, name: str | None, kind: Kind | None) -> Any:
        """The start, which learns what it is for."""
        for mark in self.marks:
            if name is not None and mark.given == name:
                if not np.array_equal(mark.start, start):
                    raise fail(
                        f"free number {name!r}", f"one start in all places, {mark.start.tolist()}", start.tolist()
                    )
                return marked(start, mark.told)
        self.marks.append(_Mark(start, name, kind))
        return marked(start, self.marks[-1].told)

    def parameters(self) -> Parameters:
        """All of them; one without a name is called after its place."""
        taken = {mark.given for mark in self.marks if mark.given is not None}
        found = []
        for mark in self.marks:
            name = mark.given or _new(mark.place or "free number", taken)
            taken.add(name)
            domain = REAL if mark.domain is None else mark.domain
            one = Parameter(name, mark.start, domain)
            to_line(name, domain, mark.start)
            found.append(one)
        return Parameters(tuple(found))


class _Given:
    """Puts values in their places: by name, and in the order of asking where no name was given."""

    def __init__(self, parameters: Parameters, named: tuple[bool, ...], values: Mapping[str, Any]):
        self.values = values
        self.unnamed = iter([one.name for one, own in zip(parameters.every, named, strict=True) if not own])

    def read(self, start: np.ndarray, name: str | None, kind: Kind | None) -> Any:
        """The value."""
        key = next(self.unnamed, "") if name is None else name
        if key not in self.values:
            raise fail(
                "network", "the same free numbers each time it is built", "another one" if name is None else name
            )
        return self.values[key]


@readable
@dataclass(frozen=True)
class Description:
    """A function that returns a network, and what is free in it; `named`: which names are the user's."""

    build: Build
    parameters: Parameters
    named: tuple[bool, ...]

    def at(self, values: Mapping[str, Any]) -> Network:
        """The network with these values."""
        with _reading(_Given(self.parameters, self.named, values)), jax.enable_x64(True):
            try:
                return checked(self.build())
            except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
                expected = "free numbers that only jax.numpy computes with, so that derivatives pass"
                got = f"one that is read: {shown_error(error)}"
                raise fail("network to be learned", expected, got) from error

    @cached_property
    def start(self) -> Network:
        """The network at its starts."""
        return self.at({one.name: plain_number(one.start) for one in self.parameters.every})

    def at_point(self, x: Float[np.ndarray, " p"]) -> Network:
        """The network at a point of the line, of plain numbers."""
        return self.at(self.parameters.known(x))


def describe(network: Build) -> Description:
    """What is free in the network that a function returns.

    Raises:
        ValueError: no function, one that returns no network, or nothing free.
    """
    if isinstance(network, Network):
        expected = "a function that returns it with hg.free(...) in it, so that it can be built with other numbers"
        raise fail("network to be learned", expected, "a Network")
    function("network to be learned", network, "nothing that returns a Network")
    asking = _Asking()
    with _reading(asking), jax.enable_x64(True):
        checked(network())
    if not asking.marks:
        raise fail("network to be learned", "at least one number marked by hg.free(start)", "none")
    parameters = asking.parameters()
    return Description(network, parameters, tuple(mark.given is not None for mark in asking.marks))


def checked(network: object) -> Network:
    """What the function returned."""
    return instance("network to be learned", network, Network, "a function that returns a Network")


def plain_number(value: Array) -> float | np.ndarray:
    """A number as a float, more of them as an array."""
    return float(value) if np.ndim(value) == 0 else np.asarray(value)


def _new(name: str, taken: set[str]) -> str:
    if name not in taken:
        return name
    return next(f"{name} {i}" for i in range(2, 10_000) if f"{name} {i}" not in taken)
