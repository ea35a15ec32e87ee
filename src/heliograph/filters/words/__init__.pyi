"""Names that other folders take; the package loads them when first used."""

from .linear import LinearWordsFilter as LinearWordsFilter
from .linear import SEEN as SEEN
from .linear import build_behind_words as build_behind_words
from .overload import Overload as Overload
