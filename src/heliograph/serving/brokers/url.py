"""Where a broker is and how to speak to it: a URL, and what the environment adds; what is secret is never shown."""

import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import unquote, urlsplit

from heliograph.numerics.check import fail, table, text

PORTS = {"mqtt": 1883, "mqtts": 8883, "nats": 4222, "nats+tls": 4222}
SECURE = ("mqtts", "nats+tls")
TOPIC = "heliograph"  # where messages are, if the URL does not say
USER, PASSWORD = "HELIOGRAPH_BROKER_USER", "HELIOGRAPH_BROKER_PASSWORD"
CERTIFICATE, KEY = "HELIOGRAPH_BROKER_CERTIFICATE", "HELIOGRAPH_BROKER_KEY"


@dataclass(frozen=True)
class Address:
    """A broker: its kind (mqtt or nats), host, port, and the topic under which the messages of a service are.

    Printed it is the URL without user and password.
    """

    kind: str
    host: str
    port: int
    topic: str
    secure: bool
    user: str | None = field(default=None, repr=False)
    password: str | None = field(default=None, repr=False)

    def __str__(self) -> str:
        return f"{self.kind}{'+tls' if self.secure else ''}://{self.host}:{self.port}/{self.topic}"

    def tls(self) -> ssl.SSLContext | None:
        """What a secure connection needs; the authorities are the system's, or those of the file SSL_CERT_FILE.

        A certificate of our own is in the files that HELIOGRAPH_BROKER_CERTIFICATE and HELIOGRAPH_BROKER_KEY name.
        """
        if not self.secure:
            return None
        context = ssl.create_default_context()
        if certificate := os.environ.get(CERTIFICATE):
            context.load_cert_chain(certificate, os.environ.get(KEY))
        return context


def address(url: str, environment: Mapping[str, str] = os.environ) -> Address:
    """A broker's URL: `mqtt`, `mqtts`, `nats` or `nats+tls`, ://user:password@host:port/topic; the host must be there.

    User and password may also be in HELIOGRAPH_BROKER_USER and HELIOGRAPH_BROKER_PASSWORD, which come before the URL's,
    where other users of the machine would see them.

    Raises:
        ValueError: another kind of URL, no host, a topic with wildcards. It never tells the password.
    """
    text("broker", url)
    environment = table("environment", environment, "texts")
    shape = f"{', '.join(f'{scheme}://' for scheme in PORTS)} and host:port/topic"
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        raise fail("broker", shape, "an address that cannot be read") from None
    if parts.scheme not in PORTS or not host or parts.query or parts.fragment:
        raise fail("broker", shape, f"{parts.scheme}://{host or ''}")
    topic = unquote(parts.path).strip("/") or TOPIC
    if any(sign in topic for sign in "*>+#.$ ") or not topic.isprintable():
        raise fail("broker, topic", "words between slashes, without . * > + # $ and spaces", topic)
    user = environment.get(USER) or (unquote(parts.username) if parts.username else None)
    password = environment.get(PASSWORD) or (unquote(parts.password) if parts.password else None)
    kind = "mqtt" if parts.scheme.startswith("mqtt") else "nats"
    return Address(kind, host, port or PORTS[parts.scheme], topic, parts.scheme in SECURE, user, password)
