"""Arithmetic and checks that know nothing of estimation."""


def __getattr__(name: str) -> object:
    """Load a name that other folders take; nothing is imported before, as in `heliograph` itself.

    It is called only for the first such name. Then the functions of `lazy_names` replace it.
    """
    from heliograph.numerics.lazy_exports import lazy_names

    here = globals()
    here["__getattr__"], here["__dir__"], here["__all__"] = lazy_names(__name__, __file__)
    return here[name] if name in here else here["__getattr__"](name)
