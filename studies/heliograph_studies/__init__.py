"""Studies made of the library's public parts: publications reproduced and examples, each in a folder of its own.

`heliograph reproduce` and `heliograph example` list and run them; in Python each is a module with `Setting` and `run`.
What all of them are made of stands here; figures are in `curves`.
"""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
