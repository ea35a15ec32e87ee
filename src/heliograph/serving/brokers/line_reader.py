"""Lines of a pipe to messages: JSON, logs of MQTT clients, or a table of CSV, as the first lines say."""

import json
import os
import re
import stat
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from heliograph.files.messages.message_files import FileMessage, parse_message_document, parse_message_line
from heliograph.files.messages.own_format import HeliographMessageReader, is_own_message
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, file_path, flag, instance
from heliograph.serving.brokers.arrival_order import ArrivalOrder
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.brokers.table_line_reader import TableLineReader, read_own_event
from heliograph.serving.brokers.transport import LOG
from heliograph.serving.message import LONGEST, Message, Payload, Read, UnreadMessage, read_messages
from heliograph.simulation.network import Network

# The first line of a document of JSON over several lines: it begins with [ and does not end with ], or is { alone.
OPENS = re.compile(rb"\s*(?:\[(?!.*\]\s*$)|\{\s*$)")
CLOSES = re.compile(rb"[\]}]")  # the last one, which is not indented


class LineReader:
    """Reads lines of a pipe as messages of a network; those of a file in the order of their arrivals.

    Args:
        network: the network.
        translator: the sources of the network's file; None if it has none.
        path: the file that is redirected, whose name may be a topic; None of any other pipe.
        ignore_unknown: whether columns that the network does not know are left out (default False).

    Attributes:
        source: where the lines come from, for errors.

    Raises:
        ValueError: no network, translator or path.
    """

    def __init__(
        self,
        network: Network,
        translator: Translator | None = None,
        path: Path | None = None,
        ignore_unknown: bool = False,
    ):
        """Prepare readers of all kinds of lines; the first lines tell which kind they are.

        Args:
            network: the network.
            translator: reads messages that other programs make, by the sources (where which value stands) in the
                network's file; None if it has none.
            path: the file that standard input is redirected from, whose name may be a topic; None for any other pipe.
            ignore_unknown: whether columns that the network does not know are left out.
        """
        instance("network", network, Network, "a Network")
        if translator is not None:
            instance("translator", translator, Translator, "a Translator, or None")
        path = None if path is None else file_path("path", path)
        ignore_unknown = flag("ignore_unknown", ignore_unknown)
        self.source = "standard input" if path is None else str(path)
        # One reader for each kind of lines. Messages that other programs make, and the topic of those that name none:
        self._translator = translator
        self._topic = None if translator is None else translator.topic_of(path)
        # Messages in heliograph's own form, and the rows of a table:
        self._own = HeliographMessageReader(network, self.source, ignore_unknown, table=False)
        self._table = TableLineReader(network, translator, path, ignore_unknown)
        # What is known so far: whether the lines are a table (None before the first that tells); the lines of a JSON
        # document that has begun and not ended; the number of the newest line; whether dates came without a zone.
        self._is_table: bool | None = None
        self._document: list[bytes] | None = None
        self._number = 0
        self._is_local = False
        # Messages of a file are put in order of arrival; messages of a pipe are passed on as they come.
        self._order = None if path is None else ArrivalOrder(self.source, TIME_STEP not in network.inputs)

    def read(self, lines: Sequence[bytes]) -> list[Payload]:
        """Return the messages of non-empty lines; messages of a file may wait until earlier ones have come.

        Raises:
            ValueError: the header of a table names no columns, or other columns than expected.
        """
        payloads, rows = list[Payload](), list[str]()
        # `_is_table` is None until a line names columns. Then all lines after it are rows of a table.
        for line in lines:
            if self._is_table is None:
                self._is_table = self._table.names_columns(_decode_line(line)) or None
            if self._is_table:
                rows.append(_decode_line(line))
            else:
                self._number += 1
                payloads += self._read_line(line)
        payloads += self._table.read(rows) if rows else []
        if not self._is_local and (self._own.local or self._table.local):
            self._is_local = True  # said once
            again = "in local time an hour comes twice when summer time ends"
            LOG.warning("%s: dates without a zone are taken as UTC; %s", self.source, again)
        return payloads if self._order is None else self._order.add_messages(payloads)

    def end(self) -> list[Payload]:
        """Return the messages that are left when no more lines come: of a table or of an unfinished document.

        Messages of a file that waited for earlier ones (in `_order`) are returned too.
        """
        if self._is_table:
            last = self._table.end()
        elif self._document is not None:
            last = self._read_document_or_lines(self._document)
        else:
            last = []
        return last if self._order is None else [*self._order.add_messages(last), *self._order.take_rest()]

    def _read_line(self, line: bytes) -> list[Payload]:
        """Return the messages of a line that is not of a table; [] while a document over several lines goes on."""
        # `_document`: lines of a document that has begun, else None. `_is_table`: None until a message shows the form.
        if self._document is not None:
            self._document.append(line)
            is_last = CLOSES.match(line) is not None
            return self._read_document_or_lines(self._document) if is_last else []
        if self._is_table is None and OPENS.match(line):
            self._document = [line]
            return []
        if len(line) > LONGEST:  # the service refuses it
            return [line]
        (read,) = read_messages([line])
        if not isinstance(read, str | UnreadMessage):
            self._is_table = False
            return [read]
        messages = parse_message_line(f"{self.source}, line {self._number}", _decode_line(line))
        return [payload for message in messages for payload in self._interpret_message(message, read)]

    def _read_document_or_lines(self, lines: list[bytes]) -> list[Payload]:
        """Return the messages of a JSON document of several lines; of each line by itself if they are no document."""
        self._document = None
        with suppress(InputError):
            messages = parse_message_document(b"\n".join(lines), self.source)
            return [payload for message in messages for payload in self._interpret_message(message, None)]
        # The lines are no document. Read each by itself, and count it (`_number`) again; it is no row of a table.
        self._is_table, self._number = False, self._number - len(lines)
        payloads = list[Payload]()
        for line in lines:
            self._number += 1
            payloads += self._read_line(line)
        return payloads

    def _interpret_message(self, message: FileMessage | InputError, read: Read | None) -> list[Payload]:
        """Return what one message of a line or document says, as payloads for the service.

        A message in another form than heliograph's own, or with a topic, goes to the translator, which knows the
        senders' forms. One in our own form is read as a message to a service if it is one, else as an event in a file.
        A payload is a message, or the reason why it cannot be read.

        Args:
            message: the message, or why it could not be read.
            read: the line as `read_messages` read it; None if the message is a part of a document, not read so far.
        """
        if isinstance(message, InputError):
            return [str(message)]
        is_own = message.topic is None and is_own_message(message.content)
        if self._translator is not None and not is_own:
            self._is_table = False
            return [*self._translator.decode(message, self._topic)]
        if read is None:
            (read,) = read_messages([json.dumps(message.content).encode()])
        if not is_own:  # nobody knows its form: `read` says why it is no message
            return [read]
        self._is_table = False
        if not isinstance(read, str | UnreadMessage):
            return [read]
        # It is no message to a service: read it as an event of a file. If it is none either, `read` says why.
        payloads = read_own_event(self._own, message.where, message.content)
        return payloads if any(isinstance(payload, Message) for payload in payloads) else [read]


def redirected_file(descriptor: int) -> Path | None:
    """Return the path of the file that a descriptor reads, or None for a pipe or if the system does not tell it.

    The path is relative to the working directory if the file is below it.
    """
    with suppress(OSError):
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
            return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
    return None


def _decode_line(line: bytes) -> str:
    """Return a line as text, in which bytes that are no UTF-8 are kept as surrogates."""
    return line.decode("utf-8", "surrogateescape")
