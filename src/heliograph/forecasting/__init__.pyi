"""Public names of the room; the package loads them when first used."""

from .paths import (
    Paths as Paths,
    draw_paths as draw_paths,
)
from .threshold import (
    Crossing as Crossing,
    crossing as crossing,
)
from .backtest import (
    Backtest as Backtest,
    Score as Score,
)
from .prediction import (
    Forecast as Forecast,
    Prediction as Prediction,
)
