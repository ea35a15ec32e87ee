"""Public names of the room; the package loads them when first used."""

from .centred_signal import (
    centred as centred,
    expected_signal as expected_signal,
)
from .channel import (
    delayed as delayed,
    mean_gain as mean_gain,
    silent as silent,
    with_direct_link as with_direct_link,
)
from .augmented.clocks import (
    Clock as Clock,
    with_clocks as with_clocks,
)
from .augmented.joint_sensors import (
    joint_sensor as joint_sensor,
)
from .estimate import (
    Estimate as Estimate,
    Innovation as Innovation,
    weakest as weakest,
)
from .fading import (
    memory_matters as memory_matters,
    with_flag as with_flag,
    without_memory as without_memory,
    autoregressive_fading as autoregressive_fading,
)
from .markov_jump_models import (
    ModalPlant as ModalPlant,
    ModalSensor as ModalSensor,
)
from .over_time import (
    at as at,
    over_time as over_time,
    steps_covered as steps_covered,
    OverTime as OverTime,
)
from .augmented.past_outputs import (
    with_past as with_past,
)
from .relays import (
    RelayNetwork as RelayNetwork,
)
from .sensor import (
    AbstractSensor as AbstractSensor,
)
from .augmented.bias import (
    with_bias as with_bias,
)
from .channel_side_information import (
    Pilot as Pilot,
    told as told,
)
from .trigger import (
    AbstractTrigger as AbstractTrigger,
    SendReason as SendReason,
)
