"""Theory beside `hg.design`: a sensor with feedback, choices and schedules of sensors, relays on a line.

No study of its own: what pages of the documentation use, and the library itself does not.
"""

from heliograph_studies.theory.feedback import FeedbackLimit as FeedbackLimit
from heliograph_studies.theory.feedback import fed_back_channel as fed_back_channel
from heliograph_studies.theory.feedback import feedback_limit as feedback_limit
from heliograph_studies.theory.relay_line import RelayLine as RelayLine
from heliograph_studies.theory.relay_line import best_relays as best_relays
from heliograph_studies.theory.relay_line import relay_line as relay_line
from heliograph_studies.theory.sending import Bursts as Bursts
from heliograph_studies.theory.sending import Choice as Choice
from heliograph_studies.theory.sending import SendingSchedule as SendingSchedule
from heliograph_studies.theory.sending import best_schedule as best_schedule
from heliograph_studies.theory.sending import burst_sending as burst_sending
from heliograph_studies.theory.sending import choose_sensors as choose_sensors
from heliograph_studies.theory.sending import information_at as information_at
from heliograph_studies.theory.sending import steady_error as steady_error
