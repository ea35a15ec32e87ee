"""Names with units: a text that also has a unit, so that whatever only needs the name does not change."""

from collections.abc import Iterable


class NameWithUnit(str):
    """Name of a state, output or input with its unit; equal to, and hashed as, the name alone.

    Attributes:
        unit: unit, such as "m/s".
    """

    unit: str

    def __new__(cls, name: str, unit: str) -> "NameWithUnit":
        """Make the name, with its unit."""
        result = super().__new__(cls, name)
        result.unit = unit
        return result

    def __reduce__(self) -> tuple[type["NameWithUnit"], tuple[str, str]]:
        """Return what a copy in another process is made from."""
        return NameWithUnit, (str(self), self.unit)


def unit_of(name: str) -> str:
    """Return the unit of a name, or an empty text."""
    return name.unit if isinstance(name, NameWithUnit) else ""


def with_unit(name: str) -> str:
    """Return a name with its unit in parentheses, if it has one, as on an axis: "position (m)"."""
    unit = unit_of(name)
    return f"{name} ({unit})" if unit else str(name)


def units_in(names: Iterable[str]) -> dict[str, str]:
    """Return the units of names that have one, by name."""
    return {str(name): unit for name in names if (unit := unit_of(name))}
