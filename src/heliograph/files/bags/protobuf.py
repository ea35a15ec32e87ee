"""Messages of Protocol Buffers, by the description of their types that a file holds: dictionaries, as JSON has them."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

# How a number stands in a message: its wire type.
VARINT, FIXED64, SIZED, FIXED32 = 0, 1, 2, 5
STAMP = "google.protobuf.Timestamp"
MESSAGE, ENUM, TEXT, BYTES, GROUP = 11, 14, 9, 12, 10  # types of fields, by FieldDescriptorProto
REPEATED = 3  # a label
DEEPEST = 64  # messages within messages

Wire = bytes | int


def _decode_zigzag(number: int) -> int:
    """Return the signed number that a varint stands for, of types sint32 and sint64."""
    return (number >> 1) ^ -(number & 1)


def _decode_signed(number: int) -> int:
    """Return the signed number of 64 bits in two's complement."""
    return number - (1 << 64) if number >> 63 else number


class ScalarReader(NamedTuple):
    """How a type of number is read."""

    wire: int  # its encoding: VARINT, FIXED32 or FIXED64
    read: Callable[[Any], Any]  # makes the number from the bytes of a fixed length, or from the integer of a varint


def _make_fixed_reader(layout: str) -> Callable[[bytes], Any]:
    """Return a function from the bytes of a number of fixed length to the number; `layout` is a format of `struct`."""
    return lambda data: struct.unpack(layout, data)[0]


SCALARS = {  # by type of FieldDescriptorProto
    1: ScalarReader(FIXED64, _make_fixed_reader("<d")),
    2: ScalarReader(FIXED32, _make_fixed_reader("<f")),
    3: ScalarReader(VARINT, _decode_signed),
    4: ScalarReader(VARINT, int),
    5: ScalarReader(VARINT, _decode_signed),
    6: ScalarReader(FIXED64, _make_fixed_reader("<Q")),
    7: ScalarReader(FIXED32, _make_fixed_reader("<I")),
    8: ScalarReader(VARINT, bool),
    13: ScalarReader(VARINT, int),
    15: ScalarReader(FIXED32, _make_fixed_reader("<i")),
    16: ScalarReader(FIXED64, _make_fixed_reader("<q")),
    17: ScalarReader(VARINT, _decode_zigzag),
    18: ScalarReader(VARINT, _decode_zigzag),
}
LENGTHS = {FIXED64: 8, FIXED32: 4}


class FieldDescriptor(NamedTuple):
    """A field of a type of Protocol Buffers messages, as the schema describes it.

    Args:
        name: its name.
        kind: number of its type, as FieldDescriptorProto has it: MESSAGE, ENUM, TEXT, BYTES, GROUP or a key of SCALARS.
        of: full name of its message or enumeration type, "" for others.
        repeated: whether it is a list.
        implicit: whether absence from a message means 0, false or "".
    """

    name: str
    kind: int
    of: str
    repeated: bool
    implicit: bool


@dataclass(frozen=True)
class ProtobufSchema:
    """Message types and enumerations of Protocol Buffers that a file describes, by which messages are decoded.

    Args:
        messages: fields of each message by their numbers, by the message's full name.
        enums: names of the values of each enumeration, by its full name.
    """

    messages: dict[str, dict[int, FieldDescriptor]]
    enums: dict[str, dict[int, str]]

    @staticmethod
    def of(data: bytes) -> "ProtobufSchema":
        """Return the schema in an encoded FileDescriptorSet (files of types); raise ValueError for other data."""
        schema = ProtobufSchema({}, {})
        # Field numbers in descriptor.proto: the set has 1 (file); a file has 2 (package), 4 (message types),
        # 5 (enumerations) and 12 (syntax).
        for file in _list_values_of_field(data, 1):
            syntax = _read_text_field(file, 12)
            package = _read_text_field(file, 2)
            prefix = f"{package}." if package else ""
            implicit = syntax == "proto3"
            for message_type in _list_values_of_field(file, 4):
                schema._add_message_type(message_type, prefix, implicit)
            for enumeration in _list_values_of_field(file, 5):
                schema._add_enum(enumeration, prefix, implicit)
        return schema

    def _add_message_type(self, data: bytes, prefix: str, implicit: bool) -> None:
        """Read the descriptor of a type of messages, and of those within it, into the tables of the schema.

        Args:
            data: the descriptor, encoded; its fields have the numbers that descriptor.proto gives them.
            prefix: full name of what it stands in, with a dot.
            implicit: whether an absent field has its default, as in proto3.
        """
        name = prefix + _read_text_field(data, 1)
        fields = dict[int, FieldDescriptor]()
        for content in _list_values_of_field(data, 2):
            # Numbers in the description of a field: 1 name, 3 its number in messages, 4 label, 5 kind, 6 type's name.
            found = {number: value for number, _, value in read_fields(content)}
            # A field of a oneof (9), one declared optional (17) and a message are absent where they are not sent.
            has_presence = 9 in found or found.get(17) == 1 or found[5] == MESSAGE
            fields[int(found[3])] = FieldDescriptor(
                name=_decode_text(found[1]),
                kind=int(found[5]),
                of=_decode_text(found.get(6, b"")).removeprefix("."),
                repeated=found.get(4) == REPEATED,
                implicit=implicit and not has_presence,
            )
        self.messages[name] = fields
        # Types that are described within this one: 3 messages, 4 enumerations.
        for number, add in ((3, self._add_message_type), (4, self._add_enum)):
            for content in _list_values_of_field(data, number):
                add(content, f"{name}.", implicit)

    def _add_enum(self, data: bytes, prefix: str, implicit: bool) -> None:
        """Read the descriptor of an enumeration into `self.enums`, {full name: {number: name of the value}}.

        `prefix` is the full name of the package or message around it, with a dot. `implicit` is not used here. The
        descriptor has the fields 1 (name) and 2 (values). A value has 1 (name) and 2 (number, 0 if absent).
        """
        name_of_number = {}
        for content in _list_values_of_field(data, 2):
            fields = {number: value for number, _, value in read_fields(content)}
            name_of_number[_decode_signed(int(fields.get(2, 0)))] = _decode_text(fields[1])
        self.enums[prefix + _read_text_field(data, 1)] = name_of_number

    def decode(self, data: bytes, name: str, depth: int = 0) -> dict[str, Any]:
        """Return a message as a dictionary by the names of its fields.

        Values of enumerations become their names, a `Timestamp` a dictionary of `sec` and `nsec`, and bytes None. A
        field that is absent gets its default, if the schema says that absence means the default (`implicit`). STAMP is
        the name of the type `Timestamp`.

        Args:
            data: the message.
            name: full name of its type.
            depth: how many messages it stands in; above DEEPEST it is refused, since the bytes may be made to nest.

        Raises:
            ValueError: bytes that are no such message, or a type that is not in the schema.
        """
        if name not in self.messages or depth > DEEPEST:
            raise ValueError(f"no type {name!r} in the schema" if depth <= DEEPEST else "messages nested too deeply")
        fields = self.messages[name]
        content: dict[str, Any] = {f.name: [] if f.repeated else self._choose_default(f) for f in fields.values()
                                   if f.repeated or f.implicit}  # fmt: skip
        # The message is a sequence of (number of the field, wire type, value). A repeated field collects its values, of
        # which several may be packed in one; of any other field the last value counts.
        for number, wire, value in read_fields(data):
            field = fields.get(number)
            if field is None:  # of a newer schema
                continue
            values = [self._read_value(field, each, depth) for each in _split_packed(field, wire, value)]
            if field.repeated:
                content[field.name] += values
            elif values:
                content[field.name] = values[-1]
        if name == STAMP:  # its type is defined in proto3, so that both fields are there even if they are 0
            return {"sec": content["seconds"], "nsec": content["nanos"]}
        return content

    def _read_value(self, field: FieldDescriptor, value: Any, depth: int) -> Any:
        """Return a field's value as in JSON: a message is an object, an enumeration's value its name, and bytes None.

        `depth` counts the messages around this one. `field.of` is the full name of the message's or enumeration's type.
        A field's kind is a type of message, enumeration, text, bytes, or one of SCALARS, numbers with a function that
        reads each.
        """
        if field.kind == MESSAGE:
            return self.decode(value, field.of, depth + 1)
        if field.kind == ENUM:
            number = _decode_signed(value)
            return self.enums.get(field.of, {}).get(number, number)
        if field.kind == TEXT:
            return _decode_text(value)
        return None if field.kind == BYTES else SCALARS[field.kind].read(value)

    def _choose_default(self, field: FieldDescriptor) -> Any:
        """Return the value of a field that a message leaves out.

        It is 0, false or "", the name of an enumeration's value 0, or None for bytes. Of the kinds below, 1 is double,
        2 is float and 8 is bool. All other kinds are integers.
        """
        if field.kind == ENUM:
            return self.enums.get(field.of, {}).get(0, 0)
        if field.kind in (TEXT, BYTES):
            return "" if field.kind == TEXT else None
        return {1: 0.0, 2: 0.0, 8: False}.get(field.kind, 0)


def read_fields(data: bytes) -> Iterator[tuple[int, int, Wire]]:
    """Yield number, wire type and encoded value of each field of a message, as they stand in its bytes.

    The value is an integer for the wire type VARINT, else bytes. LENGTHS has the bytes of the wire types of fixed
    length; a value of the type SIZED has its length before it.

    Raises:
        ValueError: the bytes are no message, or one that was cut off.
    """
    at = 0
    while at < len(data):
        key, at = _read_varint(data, at)
        number, wire = key >> 3, key & 7  # the wire type is in the lowest three bits of the key
        value: Wire
        if wire == VARINT:
            value, at = _read_varint(data, at)
        else:
            size = LENGTHS.get(wire, -1)
            if wire == SIZED:
                size, at = _read_varint(data, at)
            if size < 0 or at + size > len(data) or not number:
                raise ValueError("no message of Protocol Buffers, or one that was cut off")
            value, at = data[at : at + size], at + size
        yield number, wire, value


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the integer that begins at byte `at`, and the byte after its end.

    Each byte holds seven bits, the lowest ones first. Its highest bit says that another byte follows. An integer has at
    most ten bytes, and only its lowest 64 bits count. `data`: the bytes.
    """
    number = shift = 0
    for position in range(at, min(at + 10, len(data))):
        byte = data[position]
        number |= (byte & 127) << shift
        if byte < 128:
            return number & (1 << 64) - 1, position + 1
        shift += 7
    raise ValueError("no message of Protocol Buffers, or one that was cut off")


def _split_packed(field: FieldDescriptor, wire: int, value: Wire) -> list[Wire]:
    """Return the encoded values of a field: one, or several for a packed list, whose values share one block of bytes.

    VARINT is an integer of as many bytes as it needs, SIZED a block of bytes; LENGTHS has the bytes of the other wire
    types.

    Args:
        field: the field, as the schema declares it.
        wire: wire type in the message: how the value is encoded (an integer, a fixed number of bytes, or sized bytes).
        value: the encoded value in the message: an integer, or bytes.

    Raises:
        ValueError: a field of a type that is not read, or of another one than the schema's.
    """
    # A single value has the wire type of the schema.
    expected = _find_wire_type(field)
    if wire == expected:
        return [value]
    # A list may be packed: its values one after another, in one block of bytes.
    if not (field.repeated and wire == SIZED and isinstance(value, bytes)):
        raise ValueError(f"field {field.name!r} is of another type than the schema's")
    values, at = list[Wire](), 0
    while at < len(value):
        if expected == VARINT:
            number, at = _read_varint(value, at)
            values.append(number)
        else:
            size = LENGTHS[expected]
            values.append(value[at : at + size])
            at += size
    return values


def _find_wire_type(field: FieldDescriptor) -> int:
    """Return a field's wire type, which says how its value is laid out; raise ValueError if its type is not read.

    SIZED: the value's length stands before it. VARINT: an integer that takes as many bytes as it needs. SCALARS has the
    wire type of each kind of number.
    """
    if field.kind in (TEXT, BYTES, MESSAGE):
        return SIZED
    if field.kind == ENUM:
        return VARINT
    if field.kind not in SCALARS:
        raise ValueError(f"field {field.name!r} is of a type that is not read")
    return SCALARS[field.kind].wire


def _list_values_of_field(data: bytes, wanted: int) -> list[bytes]:
    """Return the values of all fields with the number `wanted` in an encoded message, if they are bytes.

    Such a value is an encoded message or a text.
    """
    return [value for number, _, value in read_fields(data) if number == wanted and isinstance(value, bytes)]


def _read_text_field(data: bytes, number: int) -> str:
    """Return the text in the last field with this number in an encoded message; "" if there is no such field."""
    return _decode_text((_list_values_of_field(data, number) or [b""])[-1])


def _decode_text(value: Any) -> str:
    """Return a value's bytes as text; raise ValueError if the value is a number."""
    if not isinstance(value, bytes):
        raise ValueError("a number where a text is expected")
    return value.decode()
