"""Public names of the room, which needs the extra `live`; the package loads them when first used."""

from .service import (
    Fleet as Fleet,
    NetworkProgram as NetworkProgram,
    Options as Options,
    Service as Service,
)
from .message import (
    Message as Message,
)
from .brokers.opcua import (
    Reporting as Reporting,
    read_reporting as read_reporting,
)
from .output import (
    Estimates as Estimates,
    Output as Output,
    Refused as Refused,
)
from .thresholds import (
    Threshold as Threshold,
    parse_threshold as parse_threshold,
)
from .storage.store_protocol import (
    AwayError as AwayError,
    InMemoryStore as InMemoryStore,
    identity as identity,
)
from .storage.store import (
    Store as Store,
)
from .service_assembly import (
    make_transport as make_transport,
)
from .brokers.transport import (
    Batch as Batch,
    Transport as Transport,
    Part as Part,
    TakenOverError as TakenOverError,
    part_of as part_of,
    encode_name as encode_name,
)
from .brokers.source_translator import (
    Translator as Translator,
)
from .brokers.line_reader import (
    LineReader as LineReader,
)
from .brokers.pipe import (
    Pipe as Pipe,
)
from .brokers.state_topics import (
    StatePublishing as StatePublishing,
    StateTopics as StateTopics,
)
from .brokers.broker_address import (
    Address as Address,
    parse_address as parse_address,
)
from .service_loop import (
    keep_running as keep_running,
    serve_until as serve_until,
)
from .brokers.transport_contract import (
    Broker as Broker,
    check_transport as check_transport,
)
from .brokers.replay import (
    Link as Link,
    delay_as_traced as delay_as_traced,
    encode_messages as encode_messages,
    recorded as recorded,
    simulate_link as simulate_link,
)
