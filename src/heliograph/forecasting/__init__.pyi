"""Public names of the room; the package loads them when first used."""

from .sample_paths import (
    Paths as Paths,
    draw_paths as draw_paths,
)
from .threshold_crossing import (
    Crossing as Crossing,
    crossing as crossing,
)
from .backtest import (
    Backtest as Backtest,
    Score as Score,
)
from .auxiliary_residuals import (
    Disturbances as Disturbances,
    Shock as Shock,
    disturbances as disturbances,
)
from .one_step_predictions import (
    predict_record as predict_record,
    predict_rows as predict_rows,
)
from .residual_tests import (
    Residuals as Residuals,
    record_residuals as record_residuals,
    residuals as residuals,
)
from .forecast_result import (
    Forecast as Forecast,
    Prediction as Prediction,
)
