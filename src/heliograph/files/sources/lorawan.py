"""Sources of uplinks of LoRaWAN servers: The Things Stack v3 and ChirpStack v4."""

from typing import NamedTuple

from heliograph.files.sources.derived_values import Computed, Yaw, ZeroIfAbsent
from heliograph.files.sources.message_reading import read_texts
from heliograph.files.sources.source_description import Count, Name, Paths, Source, Texts, json_field, read_paths
from heliograph.numerics.check import fail, show_value

COUNT_BITS = 16  # of a frame
RADIO = ("rssi", "snr")  # what a gateway says of how it received an uplink


class _UplinkLayout(NamedTuple):
    """How a LoRaWAN server lays out uplinks, the messages of radio devices: topic, and dotted paths in its JSON."""

    topic: str
    values: str  # the decoded payload, in which the measured values are
    time: str  # when the uplink was received
    frames: str  # the device's running count of frames
    device: str
    reception: str  # how the first gateway received the uplink

    def make_sources(
        self, path: "Paths", node: "Name", output: "Texts", scale: float, offset: float, radio: "Texts"
    ) -> "dict[str, Source]":
        """Return {the server's topic: the source of its uplinks}.

        LoRaWAN devices send uplinks to a network server, which publishes each as a JSON message. A source says which
        fields are which values of a node; `radio` adds how the message was received. RADIO are the two names;
        COUNT_BITS, 16, are the bits of the frame counter.

        Args:
            path: dotted path within the decoded payload, or several.
            node: name of a node of the network; or the `Field` that names it.
            output: name of the output, one for each path; None for all of the node's.
            scale: factor of the values.
            offset: added after scaling.
            radio: "rssi", "snr" or both, of the first gateway in the message; None for neither.

        Raises:
            ValueError: what `json_field` refuses.
        """
        # Check the names of radio values.
        radio_names = () if radio is None else read_texts("radio", radio)
        unknown = [name for name in radio_names if name not in RADIO]
        if unknown:
            raise fail("radio of an uplink", f"some of {', '.join(RADIO)}", show_value(unknown[0]))
        # Paths of the values, then of the reception; a number of the reception that is absent is 0.
        values = _prefix_paths(self.values, path)
        reception = [ZeroIfAbsent(f"{self.reception}.{name}") for name in radio_names]
        outputs = None if output is None else [*read_texts("output", output), *radio_names]
        # The frame counter is the running count, the device the plant.
        source = json_field(
            [*values, *reception],
            node,
            outputs,
            scale=scale,
            offset=offset,
            time=self.time,
            sequence=Count(self.frames, COUNT_BITS),
            plant=self.device,
        )
        return {self.topic: source}


THE_THINGS_STACK = _UplinkLayout(
    topic="v3/+/devices/+/up",
    values="uplink_message.decoded_payload",
    time="received_at",
    frames="uplink_message.f_cnt",
    device="end_device_ids.device_id",
    reception="uplink_message.rx_metadata.0",
)
CHIRPSTACK = _UplinkLayout(
    topic="application/+/device/+/event/up",
    values="object",
    time="time",
    frames="fCnt",
    device="deviceInfo.devEui",
    reception="rxInfo.0",
)


def the_things_stack(
    path: "Paths",
    node: "Name",
    output: "Texts" = None,
    *,
    scale: float = 1.0,
    offset: float = 0.0,
    radio: "Texts" = None,
) -> "dict[str, Source]":
    """Return the sources of uplinks of The Things Stack v3, a plant for each device: `sources = {**this, ...}`.

    A source says where time, count, device and values stand in other programs' messages, here in the JSON by which this
    LoRaWAN server forwards a device's uplinks (radio messages). The time is when the uplink was received. The count is
    the device's number of the frame: it is absent at 0, and begins from 0 again after 65,535 frames and after the
    device has joined again. An uplink without the field measured nothing.

    Args:
        path: dotted path within the decoded payload, or several, as of `json_field`.
        node: name of a node of the network; or the `Field` that names it.
        output: name of the output, one for each path; None for all of the node's.
        scale: factor of the values (default 1).
        offset: added after scaling (default 0).
        radio: "rssi" (dBm), "snr" (dB) or both, as the first gateway in the message received it: numbers of these names
            that come with each message and set the law of its noise or gain (`hg.model.told`). None for neither.

    Raises:
        ValueError: what `json_field` refuses.
    """
    return THE_THINGS_STACK.make_sources(path, node, output, scale, offset, radio)


def chirpstack(
    path: "Paths",
    node: "Name",
    output: "Texts" = None,
    *,
    scale: float = 1.0,
    offset: float = 0.0,
    radio: "Texts" = None,
) -> "dict[str, Source]":
    """Return the sources of uplinks of ChirpStack v4, a plant for each device: `sources = {**this, ...}`.

    ChirpStack is a server for LoRaWAN radio; an uplink is a message of a device. A source says how values are read from
    messages of one topic. The time of measuring, the count of messages, and what is done about absent fields are as for
    `the_things_stack`.

    Args:
        path: dotted path of a value within the decoded object of the message, or several paths, as for `json_field`.
        node: name of a node of the network; or the `Field` that names it.
        output: name of the output, one for each path; None for all of the node's.
        scale: factor of the values (default 1).
        offset: added after scaling (default 0).
        radio: "rssi" (dBm), "snr" (dB) or both, as the first gateway in the message received it: numbers of these names
            that come with each message and set the law of its noise or gain (`hg.model.told`). None for neither.

    Raises:
        ValueError: what `json_field` refuses.
    """
    return CHIRPSTACK.make_sources(path, node, output, scale, offset, radio)


def _prefix_paths(prefix: str, path: Paths) -> list[str | Computed]:
    """Return the paths of values in a message from paths in the part of it that stands at the path `prefix`.

    `path`: a dotted path or the `Yaw` of a quaternion, or several of them.
    """
    paths = read_paths(path)
    return [Yaw(f"{prefix}.{part.path}") if isinstance(part, Yaw) else f"{prefix}.{part}" for part in paths]
