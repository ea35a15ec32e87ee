"""Bytes of a pipe to text in UTF-8, as they come: gzip is unpacked, UTF-16 converted."""

import codecs
import zlib

from heliograph.files.text.text_file import GZIP, OTHER_KINDS, WIDE, guess_encoding
from heliograph.numerics.check import fail

AT_ONCE = 1 << 23  # bytes that are unpacked at a time
LONGEST_START = max(map(len, OTHER_KINDS))


class TextStream:
    """Turns bytes as they come into text in UTF-8; the first of them tell whether they are packed or UTF-16.

    Args:
        source: where they come from, for errors.

    Attributes:
        broken: why the text ended before its end; "" if it did not.
    """

    def __init__(self, source: str):
        """Begin before the first byte; `source` says where the bytes come from, for errors."""
        self.source, self.broken = source, ""
        self._start: bytes | None = b""  # the first bytes, until the encoding is known; None from then on
        self._packed: bytes | None = None  # packed bytes that are not unpacked yet; None if the text is not packed
        self._unpack = zlib.decompressobj(16 + zlib.MAX_WBITS)  # 16 means gzip
        self._in_member = False  # whether a packed file has begun and not ended
        self._inside: TextStream | None = None  # reads the unpacked bytes
        self._decode: codecs.IncrementalDecoder | None = None

    @property
    def has_more(self) -> bool:
        """Return whether bytes wait to be unpacked, so that `feed` has text without more bytes."""
        return bool(self._packed) and not self.broken

    def feed(self, data: bytes, ended: bool = False) -> bytes:
        """Return the text, as UTF-8, that these bytes complete; `ended`: no more bytes will come.

        The first bytes are collected in `self._start` until they tell the encoding. Packed bytes are unpacked and read
        by `self._inside`. UTF-16 is decoded by `self._decode`. Anything else is UTF-8 already. `self.has_more`: packed
        bytes wait to be unpacked.

        Raises:
            ValueError: the bytes are no text.
        """
        if self._start is not None:
            self._start += data
            if len(self._start) < LONGEST_START and not ended and self._may_be_no_text(self._start):
                return b""
            data, self._start = self._begin_decoding(self._start), None
        if self._inside is not None:
            return self._inside.feed(self._unpack_bytes(data, ended), ended and not self.has_more)
        if self._decode is not None:
            return self._decode.decode(data, ended).encode("utf-8", "replace")
        return data

    @staticmethod
    def _may_be_no_text(start: bytes) -> bool:
        """Return whether these first bytes may be the beginning of another kind of file, or of packed text or UTF-16.

        Then more bytes are needed to choose how the text is read. These are the marks GZIP and WIDE, and those of
        OTHER_KINDS.
        """
        marks = (*OTHER_KINDS, GZIP, *WIDE, codecs.BOM_UTF8)
        return len(start) < len(WIDE[0]) or any(mark.startswith(start) for mark in marks if len(start) < len(mark))

    def _begin_decoding(self, start: bytes) -> bytes:
        """Choose how bytes are read, from the first of them; return these without UTF-8's byte order mark.

        OTHER_KINDS maps the first bytes of other kinds of files to the name of the kind. Packed files begin with GZIP.
        """
        for mark, kind in OTHER_KINDS.items():
            if start.startswith(mark):
                came = f"{kind}: heliograph replay sends it as messages"
                raise fail(self.source, "text: CSV, lines of JSON, a log", came)
        if start.startswith(GZIP):
            self._packed, self._inside = b"", TextStream(self.source)
        elif (encoding := guess_encoding(start)) != "utf-8-sig":
            self._decode = codecs.getincrementaldecoder(encoding)("replace")
        return start.removeprefix(codecs.BOM_UTF8)

    def _unpack_bytes(self, data: bytes, ended: bool) -> bytes:
        """Return the next part, of some AT_ONCE bytes, of what is packed in these bytes and in those that waited.

        Nothing comes after damage, which `self.broken` describes. `ended`: no more bytes will come. `self._packed` has
        the bytes that waited; `self._in_member` says whether a packed file has begun and not ended.
        """
        packed, results = (self._packed or b"") + data, b""
        try:
            while packed and len(results) < AT_ONCE and not self.broken:
                self._in_member = True
                results += self._unpack.decompress(packed, AT_ONCE)
                packed = self._unpack.unconsumed_tail
                if self._unpack.eof:  # another packed file may follow, which continues the text
                    packed = self._unpack.unused_data.lstrip(b"\0")
                    self._in_member = False
                    self._unpack = zlib.decompressobj(16 + zlib.MAX_WBITS)
        except zlib.error as error:
            self.broken = str(fail(self.source, "a packed file without damage", error))
        self._packed = packed
        if ended and self._in_member and not packed and not self.broken:
            self.broken = str(fail(self.source, "a packed file without damage", "one that was cut off"))
        return results
