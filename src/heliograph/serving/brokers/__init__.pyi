"""Names that other folders take; the package loads them when first used."""

from .broker_address import Address as Address
from .broker_address import parse_address as parse_address
from .broker_inspection import listen as listen
from .line_reader import LineReader as LineReader
from .line_reader import redirected_file as redirected_file
from .mqtt import Mqtt as Mqtt
from .nats import Nats as Nats
from .opcua import OpcUa as OpcUa
from .pipe import Pipe as Pipe
from .replay import Link as Link
from .replay import delay_as_traced as delay_as_traced
from .replay import encode_messages as encode_messages
from .replay import events_of_recording as events_of_recording
from .replay import simulate_link as simulate_link
from .source_translator import Translator as Translator
from .state_topics import StatePublishing as StatePublishing
from .state_topics import StateTopics as StateTopics
from .transport import FIRST as FIRST
from .transport import LOG as LOG
from .transport import LONGEST as LONGEST
from .transport import Part as Part
from .transport import TakenOverError as TakenOverError
from .transport import Transport as Transport
from .transport import WHOLE as WHOLE
from .transport import encode_name as encode_name
