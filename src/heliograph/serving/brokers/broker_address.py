"""Broker addresses: a URL, completed by environment variables; secrets are never printed."""

import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import unquote, urlsplit

from heliograph.numerics.check import fail, table, text
from heliograph.numerics.process.plugins import BROKERS, find_plugin

PORTS = {"mqtt": 1883, "mqtts": 8883, "nats": 4222, "nats+tls": 4222, "opc.tcp": 4840}
SECURE = ("mqtts", "nats+tls")
TOPIC = "heliograph"  # where messages are, if the URL does not say
USER, PASSWORD = "HELIOGRAPH_BROKER_USER", "HELIOGRAPH_BROKER_PASSWORD"
CERTIFICATE, KEY = "HELIOGRAPH_BROKER_CERTIFICATE", "HELIOGRAPH_BROKER_KEY"


@dataclass(frozen=True)
class Address:
    """Address of a broker; printed it is the URL without user and password.

    Args:
        kind: "mqtt", "nats" or "opc.tcp"; of a broker of another package the scheme of its URL.
        host: name or address of the machine.
        port: port number; 0 where the URL has none, of a broker of another package.
        topic: topic under which a service's messages are.
        secure: whether the connection uses TLS.
        user: user name, or token of a NATS server without passwords; None if the broker asks for none.
        password: password of the user.
    """

    kind: str
    host: str
    port: int
    topic: str
    secure: bool
    user: str | None = field(default=None, repr=False)
    password: str | None = field(default=None, repr=False)

    def __str__(self) -> str:
        """Return the URL, without user and password."""
        return f"{self.kind}{'+tls' if self.secure else ''}://{self.host}:{self.port}/{self.topic}"

    def tls(self) -> ssl.SSLContext | None:
        """Return the TLS context, or None if the connection is not secure.

        Authorities are the system's, or those in the file SSL_CERT_FILE. A client certificate is read from the files
        that the variables HELIOGRAPH_BROKER_CERTIFICATE (CERTIFICATE) and HELIOGRAPH_BROKER_KEY (KEY) name.
        """
        if not self.secure:
            return None
        context = ssl.create_default_context()
        if certificate := os.environ.get(CERTIFICATE):
            context.load_cert_chain(certificate, os.environ.get(KEY))
        return context


def parse_address(url: str, environment: Mapping[str, str] | None = None) -> Address:
    """Return a broker's URL, SCHEME://user:password@host:port/topic, as an address; the host must be there.

    User and password are taken from HELIOGRAPH_BROKER_USER and HELIOGRAPH_BROKER_PASSWORD if these are set, since other
    users of the machine would see them in a URL.

    Args:
        url: SCHEME://user:password@host:port/topic, where SCHEME is `mqtt`, `mqtts`, `nats`, `nats+tls` or `opc.tcp`;
            only scheme and host are required. A package that offers an entry point of the group
            `heliograph.brokers` under another scheme makes its transport.
        environment: environment variables; by default those of the process.

    Raises:
        ValueError: another kind of URL, no host, a topic with wildcards. The message contains no password.
    """
    text("broker", url)
    environment = table("environment", os.environ if environment is None else environment, "texts")
    shape = f"{', '.join(f'{scheme}://' for scheme in PORTS)} and host:port/topic"
    # Scheme, host and port; nothing of a URL that cannot be read is printed, since it may contain a password.
    try:
        parts = urlsplit(url)
        scheme, host, port = parts.scheme, parts.hostname, parts.port
    except ValueError:
        raise fail("broker", shape, "an address that cannot be read") from None
    is_known = scheme in PORTS
    is_offered = not is_known and bool(scheme) and find_plugin(BROKERS, scheme) is not None
    if not (is_known or is_offered) or not host or parts.query or parts.fragment:
        raise fail("broker", shape, f"{scheme}://{host or ''}")
    # User and password, where the environment has precedence; the topic.
    user = environment.get(USER) or (unquote(parts.username) if parts.username else None)
    password = environment.get(PASSWORD) or (unquote(parts.password) if parts.password else None)
    path = unquote(parts.path).strip("/")
    return Address(
        kind={"mqtts": "mqtt", "nats+tls": "nats"}.get(scheme, scheme),
        host=host,
        port=port or PORTS.get(scheme, 0),
        topic=path if scheme == "opc.tcp" else _check_topic(path or TOPIC),
        secure=scheme in SECURE,
        user=user,
        password=password,
    )


def _check_topic(topic: str) -> str:
    """Return a topic; raise ValueError if it has a character with a meaning in MQTT or NATS (dots, wildcards)."""
    if any(sign in topic for sign in "*>+#.$ ") or not topic.isprintable():
        raise fail("broker, topic", "words between slashes, without . * > + # $ and spaces", topic)
    return topic
