"""Networks with free numbers: a function that returns one, built again with others in the places of its marks."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any, Literal, Protocol, get_args

import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.learning.free_parameters import Parameter, Parameters, to_plain_number
from heliograph.learning.likelihood.parameter_transforms import map_to_unconstrained
from heliograph.numerics.check import array, error_text, fail, function, instance, rank, show_value
from heliograph.numerics.domains import COVARIANCE, POSITIVE, PROBABILITY, REAL, SIMPLEX, Domain, mark_checked
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.network import Network

Kind = Literal["real", "positive", "probability", "simplex", "covariance"]
Build = TypeAliasType("Build", Callable[[], Network])  # a function that returns a network

DISTANCE_FROM_START = 0.1  # unconstrained distance of a point near the start
IRRATIONAL = 0.6180339887498949  # fractions of its multiples are all different

DOMAINS: dict[Kind, Domain] = {
    "real": REAL,
    "positive": POSITIVE,
    "probability": PROBABILITY,
    "simplex": SIMPLEX,
    "covariance": COVARIANCE,
}


def free(start: ArrayLike, name: str | None = None, kind: Kind | None = None) -> Any:
    """Mark a number of a network as one to be learned, from `start`; it stands wherever the number itself would.

    An example is `hg.hop(hg.Rayleigh(hg.free(0.8, "fading")), noise=hg.free(0.3))`, inside a function that returns the
    network and that `hg.fit` calls. One name in several places is one number. Its place decides its domain: a variance
    or a scale stays positive, a probability stays between 0 and 1, probabilities sum to 1, a covariance matrix stays
    one. A gain, an entry of a matrix or a number in a user's function may be any real number, unless `kind` says
    otherwise. Outside of a fit the number is its start.

    Args:
        start: value from which the search begins, () or of any shape; of kind "simplex" it sums to 1 over the last
            axis.
        name: name in the table of results; by default the number is called after its place.
        kind: "real", "positive", "probability", "simplex" or "covariance"; decided by its place unless given.

    Raises:
        ValueError: a start that is no number, or an unknown kind.
    """
    if kind is not None and not (isinstance(kind, str) and kind in get_args(Kind)):
        raise fail("kind of a free number", f"one of {', '.join(get_args(Kind))}", show_value(kind))
    if name is not None and (not isinstance(name, str) or not name):
        raise fail("name of a free number", "a text", show_value(name))
    what = "free number" if name is None else name
    value = array(f"start of {what}", start, (None,) * rank(f"start of {what}", start))
    # Inside of a fit a reader notes the number, and answers with the value that is tried; outside there is none.
    reader = _reader.get()
    return (value if value.ndim else float(value)) if reader is None else reader.answer_free(value, name, kind)


class _FreeNumberReader(Protocol):
    """What answers the calls of `free` while a network is built."""

    def answer_free(self, start: np.ndarray, name: str | None, kind: Kind | None) -> object:
        """Return what stands in the place of the free number."""


# What `free` answers depends on who builds the network: nobody, one who asks what is free, or one who tries values.
_reader: ContextVar[_FreeNumberReader | None] = ContextVar("reader of free numbers", default=None)


@contextmanager
def answer_free_marks_by(reader: _FreeNumberReader) -> Iterator[None]:
    """Let `reader` answer all calls of `hg.free` inside the `with` block: its answer stands in the number's place.

    `hg.free` finds it in the context variable `_reader`, which is set back afterwards.
    """
    token = _reader.set(reader)
    try:
        yield
    finally:
        _reader.reset(token)


class _MarkedNumber:
    """A free number while it is being collected: its start, name, and the domain that its places leave it."""

    def __init__(self, start: np.ndarray, name: str | None, kind: Kind | None):
        """Store what the user said of the number; its places are told later by `report`.

        DOMAINS maps a kind to the values that are allowed, its domain.

        Args:
            start: value from which a search begins.
            name: its name, or None if the user gave none.
            kind: its kind if the user gave one, which decides its domain; else its places do.
        """
        self.start = start
        self.given = name
        self.place = ""  # name of the argument in which it stands, from its first report on
        self.domain = None if kind is None else DOMAINS[kind]
        self.explicit = kind is not None

    def report(self, name: str, domain: Domain) -> None:
        """Note the number's place, and narrow its domain to what the check at this place requires.

        A number may stand in several places, such as one variance in two sensors. A kind that the user gave stays. Two
        intervals are intersected. A check that requires nothing (REAL) changes nothing. Any other domain replaces the
        known one. A `Domain` of the kind "interval" goes from `low` to `high`.

        Args:
            name: name of the argument in whose place the number stands.
            domain: values that are allowed there.
        """
        self.place = self.place or name  # the first place gives the name
        if self.explicit:
            return
        known = REAL if self.domain is None else self.domain
        if known.kind == domain.kind == "interval":
            domain = Domain(low=max(known.low, domain.low), high=min(known.high, domain.high))
        elif domain == REAL:
            domain = known
        self.domain = domain


class FreeNumberCollector:
    """Reader that collects the free numbers, each at its start; checks of their places report their domains."""

    def __init__(self) -> None:
        """Begin without free numbers; `marks` will hold each in the order in which it is read."""
        self.marks: list[_MarkedNumber] = []

    def answer_free(self, start: np.ndarray, name: str | None, kind: Kind | None) -> object:
        """Return the start of a number marked `hg.free`, wrapped so that the check of its argument reports its domain.

        A checked argument (a variance, a probability) knows which values are allowed: that becomes the number's domain.
        A name met before means the same number in another place, which must have the same start. `mark_checked` wraps
        the start so that the check calls `report` with name and domain of the argument.

        Args:
            start: the number's start.
            name: its name, or None.
            kind: its kind, or None if its place decides.
        """
        for mark in self.marks:
            if name is not None and mark.given == name:
                if not np.array_equal(mark.start, start):
                    expected = f"one start in all places, {mark.start.tolist()}"
                    raise fail(f"free number {name!r}", expected, start.tolist())
                return mark_checked(start, mark.report)
        self.marks.append(_MarkedNumber(start, name, kind))
        return mark_checked(start, self.marks[-1].report)

    def parameters(self) -> Parameters:
        """Return all marked free numbers as parameters; a number without a name is named after its place.

        A number without a domain, whose place requires nothing, may be any real number.
        """
        taken = {mark.given for mark in self.marks if mark.given is not None}
        results = []
        for mark in self.marks:
            name = mark.given or _make_name_distinct(mark.place or "free number", taken)
            taken.add(name)
            domain = REAL if mark.domain is None else mark.domain
            map_to_unconstrained(name, domain, mark.start)  # raises ValueError for a start outside the domain
            results.append(Parameter(name, mark.start, domain))
        return Parameters(tuple(results))


class ValueReader:
    """Reader that puts values in their places: by name, and in the order of the marks where no name was given."""

    def __init__(self, parameters: Parameters, named: tuple[bool, ...], values: Mapping[str, object]):
        """Store the values that are to stand in the places of a network's free numbers.

        The user marks free numbers by `free(...)`, with or without a name, in the function that builds the network.
        When that function runs again, each mark asks `answer_free` for its value: a named one by its name, one without
        a name by its turn. So the names that were made up for these are kept in the order of the marks, as an iterator
        that gives the next one for each mark without a name.

        Args:
            parameters: all free numbers, in the order in which the function marks them.
            named: for each, whether the user gave it a name.
            values: the value of each parameter, by its name.
        """
        self.values = values
        self.unnamed = iter([p.name for p, is_named in zip(parameters.every, named, strict=True) if not is_named])

    def answer_free(self, start: np.ndarray, name: str | None, kind: Kind | None) -> object:
        """Return the value of the number with this name, or if it is None, of the next number that has no name.

        The function that builds the network marks its numbers in the same order each time, so that the next one without
        a name is known. `start` and `kind` are not used. `self.unnamed` yields the names of numbers that the user did
        not name, in the order of their marks; `self.values` is {name: value}.
        """
        key = next(self.unnamed, "") if name is None else name
        if key not in self.values:
            got = "another one" if name is None else name
            raise fail("network", "the same free numbers each time it is built", got)
        return self.values[key]


def _make_name_distinct(name: str, taken: set[str]) -> str:
    """Return the name itself if it is not `taken`, else the name followed by the first number that makes it new."""
    if name not in taken:
        return name
    return next(f"{name} {i}" for i in range(2, 10_000) if f"{name} {i}" not in taken)


@readable
@dataclass(frozen=True)
class Description:
    """Network with free numbers, as the function that builds it and the numbers that are free in it.

    Args:
        build: the function, without arguments, that returns the network.
        parameters: the free numbers in the order in which the network uses them.
        named: which of their names the user gave.
    """

    build: Build
    parameters: Parameters
    named: tuple[bool, ...]

    def at(self, values: Mapping[str, object]) -> Network:
        """Return the network, built with these values of its free numbers, {name: value}.

        Raises:
            ValueError: operations on a free number that JAX cannot differentiate, a function that returns no network.
        """
        with answer_free_marks_by(ValueReader(self.parameters, self.named, values)), jax.enable_x64(True):
            try:
                return require_network(self.build())
            except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
                expected = "free numbers that only jax.numpy computes with, so that derivatives pass"
                got = f"one that is read: {error_text(error)}"
                raise fail("network to be learned", expected, got) from error

    @cached_property
    def start(self) -> Network:
        """Network with every free number at its start, as plain numbers."""
        return self.at({parameter.name: to_plain_number(parameter.start) for parameter in self.parameters.every})

    @cached_property
    def near_start(self) -> Network:
        """Network at a point near the start that is no special case, as where two free gains are equal or one is 0.

        It tells whether a gain is random at all, which may not be so at the start itself. If no network can be built on
        either side of the start, it is the network at the start. `at_point` builds the network at unconstrained
        coordinates. The number IRRATIONAL makes all distances from the start different. DISTANCE_FROM_START is 0.1.
        """
        start = self.parameters.start
        fractions, _ = np.modf(IRRATIONAL * np.arange(1, len(start) + 1))  # different for each number
        away = DISTANCE_FROM_START * (1 + fractions)
        for direction in (1.0, -1.0):
            with suppress(ValueError):
                return self.at_point(start + direction * away)
        return self.start

    def at_point(self, x: Float[np.ndarray, " p"]) -> Network:
        """Return the network, of plain numbers, at unconstrained coordinates x (p,)."""
        return self.at(self.parameters.known(x))


def describe(network: Build) -> Description:
    """Return what is free in the network that a function returns: its numbers, and how to build it with others.

    A fit changes free numbers and builds the network anew with them. The function is called once here with a collector
    in place, which records each mark `hg.free(start)` and answers it by its start.

    Args:
        network: a function without arguments that returns a Network, with `hg.free(...)` in place of numbers.

    Raises:
        ValueError: no function, one that returns no network, or nothing free.
    """
    # Refuse a network itself, and a function that needs arguments.
    if isinstance(network, Network):
        expected = "a function that returns it with hg.free(...) in it, so that it can be built with other numbers"
        raise fail("network to be learned", expected, "a Network")
    function("network to be learned", network, "nothing that returns a Network")
    try:
        signature(network).bind()
    except (TypeError, ValueError) as error:
        raise fail("network to be learned", "a function without arguments", str(error)) from None
    # Call the function, and collect its marks.
    collector = FreeNumberCollector()
    with answer_free_marks_by(collector), jax.enable_x64(True):
        require_network(network())
    if not collector.marks:
        raise fail("network to be learned", "at least one number marked by hg.free(start)", "none")
    # The free numbers, with their starts and domains; and which of them the user named.
    parameters = collector.parameters()
    is_named = tuple(mark.given is not None for mark in collector.marks)
    return Description(build=network, parameters=parameters, named=is_named)


def require_network(network: object) -> Network:
    """Return what a function returned; raise ValueError if it is no network."""
    return instance("network to be learned", network, Network, "a function that returns a Network")
