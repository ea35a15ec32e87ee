"""Public names of the room; the package loads them when first used."""

from .feedback import (
    FeedbackLimit as FeedbackLimit,
    fed_back_channel as fed_back_channel,
    feedback_limit as feedback_limit,
)
