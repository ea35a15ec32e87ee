"""Messages that a broker passes on in some seconds, by topic, to inspect what is there."""

import asyncio
import threading
import time

from heliograph.files.topic_statistics import TopicStatistics, note_payload
from heliograph.numerics.check import fail
from heliograph.serving.brokers.broker_address import Address

WAIT = 10.0  # seconds that a connection may take
INTERNAL = ("$", "_INBOX")  # topics and subjects of the broker itself


def listen(address: Address, seconds: float) -> dict[str, TopicStatistics]:
    """Listen to all topics of a broker for a while, and return what came, by topic; nothing is acknowledged or stored.

    Args:
        address: the broker.
        seconds: how long to listen.

    Raises:
        ValueError: there is no connection. The error names the broker.
    """
    topics: dict[str, TopicStatistics] = {}  # each of these listeners adds what comes
    if address.kind == "opc.tcp":
        from heliograph.serving.brokers.opcua import Listener

        asyncio.run(Listener(topics).listen(address, seconds))
    elif address.kind == "mqtt":
        _listen_mqtt(address, seconds, topics)
    elif address.kind == "nats":
        asyncio.run(_listen_nats(address, seconds, topics))
    else:
        raise fail(f"broker {address}", "mqtt, nats or opc.tcp, of which topics can be listed", address.kind)
    return topics


def _listen_mqtt(address: Address, seconds: float, topics: dict[str, TopicStatistics]) -> None:
    """Note all messages of an MQTT broker by topic for some seconds, except those that it had stored before.

    Args:
        address: the broker.
        seconds: how long to listen.
        topics: by name, to which what comes is added.

    Raises:
        ValueError: no connection, or a refused one.
    """
    from paho.mqtt.client import Client, ConnectFlags, MQTTMessage
    from paho.mqtt.enums import CallbackAPIVersion
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode

    answered, refusals = threading.Event(), list[str]()

    def subscribe(client: Client, data: object, flags: ConnectFlags, code: ReasonCode, more: Properties | None) -> None:
        """Subscribe to all topics ("#") once connected, or note why the broker refuses; then set `answered`."""
        if code.is_failure:
            refusals.append(str(code))
        else:
            client.subscribe("#", 0)
        answered.set()

    def note_message(client: Client, data: object, message: MQTTMessage) -> None:
        """Note a message under its topic, with the time of its arrival."""
        if not message.retain:  # a stored message says nothing of rate and lateness
            note_payload(topics, message.topic, bytes(message.payload), time.time_ns())

    # Callbacks run in the client's thread while this one sleeps.
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_connect, client.on_message = subscribe, note_message
    if address.user is not None:
        client.username_pw_set(address.user, address.password)
    if context := address.tls():
        client.tls_set_context(context)
    client.connect_async(address.host, address.port)
    client.loop_start()
    try:
        if not answered.wait(WAIT):
            raise fail(f"broker {address}", "a connection", f"none within {WAIT:g} s")
        if refusals:
            raise fail(f"broker {address}", "a connection", f"a refusal: {refusals[0]}")
        time.sleep(seconds)
    finally:
        client.disconnect()
        client.loop_stop()


async def _listen_nats(address: Address, seconds: float, topics: dict[str, TopicStatistics]) -> None:
    """Note each message of a NATS server under its topic for some seconds.

    Args:
        address: the server.
        seconds: how long to listen.
        topics: statistics of each topic by its name, to which the messages are added.

    Raises:
        ValueError: no connection.
    """
    import nats
    from nats.aio.msg import Msg
    from nats.errors import Error

    async def note_message(received: Msg) -> None:
        """Note a message under its topic, words between slashes, but for the server's own."""
        if not received.subject.startswith(INTERNAL):
            note_payload(topics, received.subject.replace(".", "/"), received.data, time.time_ns())

    async def ignore(error: Exception) -> None:
        """Do nothing at an error, which the client would log with a traceback; what it raises is one line."""

    # A user without a password is a token.
    try:
        client = await nats.connect(
            f"nats://{address.host}:{address.port}",
            user=address.user if address.password else None,
            password=address.password,
            token=None if address.password else address.user,
            tls=address.tls(),
            allow_reconnect=False,
            max_reconnect_attempts=1,  # also before the first connection, where the client would try for two minutes
            reconnect_time_wait=0,
            connect_timeout=int(WAIT),
            error_cb=ignore,
        )
    except (Error, OSError, TimeoutError) as error:
        raise fail(f"broker {address}", "a connection", type(error).__name__) from None
    # Listen for a while, and leave.
    try:
        await client.subscribe(">", cb=note_message)
        await asyncio.sleep(seconds)
    finally:
        await client.close()
