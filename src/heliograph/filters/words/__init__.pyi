"""Names that other folders take; the package loads them when first used."""

from .linear_word_filter import LinearWordsFilter as LinearWordsFilter
from .linear_word_filter import SEEN as SEEN
from .linear_word_filter import build_behind_words as build_behind_words
from .overload import Overload as Overload
