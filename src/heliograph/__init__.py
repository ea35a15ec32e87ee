"""State estimation over relay networks: describe plant, sensors, relays and fusion once; simulate, filter, report.

Public names are listed in `__init__.pyi`, in the order data flows, and loaded when first used; this is the only stable
import path.
"""

__version__ = "0.5.0"


def __getattr__(name: str) -> object:
    """Load a public name; nothing is imported before, so that the command hears Ctrl-C from its first line on."""
    from heliograph.numerics.lazy_exports import lazy_names

    here = globals()
    here["__getattr__"], here["__dir__"], here["__all__"] = lazy_names(__name__, __file__)
    return here[name] if name in here else here["__getattr__"](name)


def __dir__() -> list[str]:
    __getattr__("__all__")
    return list(globals()["__all__"])
