"""Public names of the room; the package loads them when first used."""

from .attitude import (
    from_quaternion as from_quaternion,
    rotation_matrix as rotation_matrix,
    to_quaternion as to_quaternion,
    turn_attitude as turn_attitude,
)
from .continuous_time import (
    Discretized as Discretized,
    continuous_plant as continuous_plant,
    discretize as discretize,
)
from .runge_kutta import (
    runge_kutta_plant as runge_kutta_plant,
)
from .local_plane import (
    LocalPlane as LocalPlane,
)
from .motion import (
    constant_acceleration as constant_acceleration,
    constant_velocity as constant_velocity,
    gauss_markov as gauss_markov,
    known_turn as known_turn,
    singer as singer,
)
from .vehicles import (
    bicycle as bicycle,
    coordinated_turn as coordinated_turn,
    unicycle as unicycle,
)
from .time_series import (
    Component as Component,
    arma as arma,
    cycle as cycle,
    level as level,
    regression as regression,
    seasonal as seasonal,
    stationary as stationary,
    trend as trend,
    trigonometric_seasonal as trigonometric_seasonal,
)
from .joined_plants import (
    join as join,
)
from .structural_time_series import (
    Structural as Structural,
    structural as structural,
)
from .parts_of_estimates import (
    Components as Components,
    components as components,
)
